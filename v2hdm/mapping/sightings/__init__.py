"""What was seen, as one table, and where it lies on the ground under a rig."""
