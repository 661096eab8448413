"""The heading of a vehicle whose receiver has one antenna: from its course over ground, and a gyro."""
