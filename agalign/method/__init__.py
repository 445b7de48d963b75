"""The method of Dong et al. (2018): a descriptor is learned on the images while their homographies are optimised."""
