"""Validation of bytes from outside: texts, images, and the fields that several formats share."""
