"""The parts of `benchmarks.evaluation`."""
