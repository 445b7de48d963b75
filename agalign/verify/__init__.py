"""What is measured of an alignment without asking how it was found, and the verdict that follows."""
