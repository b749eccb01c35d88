"""Small policies for tests, as ONNX graphs."""
