"""Rendered drives with ground truth: a scene, the cameras that look at it, the ports built from both."""
