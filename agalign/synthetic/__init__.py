"""A synthetic flight with ground truth: the ground, the rig, the files, and the score of an alignment."""
