"""The stages from a drive to a map with its verdict, and what they hand on."""
