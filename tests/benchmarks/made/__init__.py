"""Drives made without pictures: what is drawn, what truly was, what was recorded, and what is detected."""
