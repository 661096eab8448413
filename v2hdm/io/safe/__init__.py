"""The gate for bytes of strangers: texts, images, and the fields that several formats share."""
