"""The method of Dong et al. (2018): a descriptor is learnt on the images while their homographies are optimised."""
