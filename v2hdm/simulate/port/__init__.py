"""A whole port and one drive through it, with ground truth."""
