"""Measurements against peers, printed as ratios; see docs/benchmarks.md."""
