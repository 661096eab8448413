"""A problem in sections, each summarised by what it says of its border, joined, and finished one by one."""
