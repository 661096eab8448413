"""Random scenes without end, for the detector to learn from."""
