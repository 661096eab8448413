"""What runs on the vehicle: onnxruntime, opencv and numpy; never torch."""
