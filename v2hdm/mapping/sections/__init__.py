"""A long drive, or many of one network, mapped in sections that are adjusted together."""
