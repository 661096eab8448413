"""``v2hdm view``: a result as a page on this machine, in which a person looks at its map and corrects it."""
