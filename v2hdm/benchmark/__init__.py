"""A benchmark of maps at the level of corners: fixed drives, and a scorer for the map of any tool."""
