"""Lane paint of all images, fused into polylines."""
