"""Mounting, clock, lens and poses estimated from bare asphalt, without any marking."""
