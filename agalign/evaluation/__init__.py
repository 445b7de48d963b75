"""The experiments of Dong et al. (2018) on image pairs: comparison of descriptors and homographies, and learning from
many pairs.

In: tables of image pairs. Out: tables of errors.
"""
