"""Example environments for tutorials, tests and benchmarks."""
