"""One module per algorithm: maps a league's settings to RLlib's AlgorithmConfig."""
