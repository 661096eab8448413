"""Frames, rigid motions, the pinhole camera and the ground plane: pure, batched torch functions."""
