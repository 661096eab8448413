"""`python -m export`: a checkpoint of `python -m train` to the ONNX file that the detector loads."""
