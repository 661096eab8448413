"""Checks before a run: a drive's statements against each other, its images and bare ground; no torch."""
