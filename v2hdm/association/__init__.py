"""Detections of one marking, associated across images, cameras and sessions."""
