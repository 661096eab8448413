"""The paint as it was built, against its design: a drawing, an earlier map, or a table of rules."""
