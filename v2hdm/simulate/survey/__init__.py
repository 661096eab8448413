"""A survey of a made network: streets and yards, several drives, detections in place of pictures."""
