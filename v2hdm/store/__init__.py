"""Files on disk and at object stores: whole or absent, listed, locked, cached."""
