"""Markings with four corners, from proposed regions over patches of ground to fitted quadrilaterals."""
