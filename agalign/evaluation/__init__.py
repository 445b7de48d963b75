"""The paper's experiments on pairs of images whose homography is known."""
