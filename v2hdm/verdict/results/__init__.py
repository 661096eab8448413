"""Checks after the solve: what a result says of its inputs and of itself."""
