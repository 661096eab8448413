"""Recordings of other tools, imported as drives."""
