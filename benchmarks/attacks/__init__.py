"""Callers and failures that a server must withstand; see benchmarks/hostile.py."""
