"""Reading and writing: drives, recordings to import, calibrations, maps; one guard against hostile bytes."""
