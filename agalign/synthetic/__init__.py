"""A synthetic flight whose truth is known: the ground, the rig, the files, and the score of an alignment."""

from agalign.synthetic.flight import make_flight

__all__ = ["make_flight"]
