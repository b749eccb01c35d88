"""Callers and failures that a server must withstand: for slow tests, and `python -m benchmarks hostile`."""
