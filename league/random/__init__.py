"""Derived seeds, and random numbers of NumPy for many seeds at once."""
