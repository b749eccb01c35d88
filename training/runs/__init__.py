"""Training runs: driver, Ray Tune trial, run directory, progress and publication queue."""
