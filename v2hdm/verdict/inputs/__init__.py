"""Checks before a run: what a drive states, held against itself, its images and its bare ground; no torch."""
