"""The paper's experiments on pairs of images: descriptors and homographies compared, and one learnt from many pairs."""
