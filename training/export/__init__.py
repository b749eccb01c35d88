"""Export of checkpoints to ONNX, parity check and publication."""
