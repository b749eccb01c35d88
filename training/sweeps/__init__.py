"""Hyperparameter sweeps: search space, trials and sweep directory."""
