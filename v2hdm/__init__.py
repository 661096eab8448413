"""Marking-level HD maps and camera calibration from monocular cameras and RTK-GNSS poses."""

__version__ = "0.1.0"
