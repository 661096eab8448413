"""A camera's calibration: from surveyed points, from bare ground, and two of them compared."""
