"""RLlib training of a league's policies: algorithms, sampling, sweeps, ONNX export and publishing."""
