"""A camera as the detector knows it: lens, ground, the band of rows that shows road."""
