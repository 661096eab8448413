"""A map to files and back."""
