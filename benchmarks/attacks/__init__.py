"""Callers and failures that a server must withstand: `python -m benchmarks attacks` and benchmarks/hostile.py."""
