"""The renderer: a scene of ground, paint and boxes, as a camera records it."""
