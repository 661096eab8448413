"""Lanes: points of detected lines on the ground, lines through them, and knots solved for with the drive."""
