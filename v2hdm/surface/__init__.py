"""The ground's surface along the paths of a drive, and the strips in which it is written."""
