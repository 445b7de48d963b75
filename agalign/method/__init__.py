"""The paper's method: a descriptor learnt on the images themselves while the homographies are optimised."""
