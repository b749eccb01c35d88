"""Training with measured time: the parts of `benchmarks.learning`."""
