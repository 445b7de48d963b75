"""What travels between the stages: records of captures, images and alignments, and the geometry they obey."""
