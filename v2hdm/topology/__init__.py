"""Lanes for planning: which lane leads to which, from lane lines and the paths of drives."""
