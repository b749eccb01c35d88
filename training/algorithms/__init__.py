"""One file per algorithm: a league's settings → RLlib's AlgorithmConfig."""
