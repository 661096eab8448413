"""Where the vehicle is, from a map's markings seen by its cameras alone."""
