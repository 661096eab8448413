"""Calibrations of cameras as files: our own, and the formats of other tools."""
