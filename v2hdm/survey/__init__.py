"""Surveyed points: read, matched with corners, used in a run, and compared with its map."""
