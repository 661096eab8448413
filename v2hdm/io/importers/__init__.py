"""Recordings and files of other tools, imported into the cache once, whole or not at all."""
