"""The method of Dong et al. (2018): a descriptor is learned on the images while their homographies are optimised.

In: images of bands with initial homographies. Out: homographies with their covariance, and the network.
"""
