"""A synthetic flight with ground truth: the ground, the rig, the files, and the score of an alignment."""

from agalign.synthetic.flight import make_flight

__all__ = ["make_flight"]
