"""Random numbers of NumPy for many seeds at once."""
