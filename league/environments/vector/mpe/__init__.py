"""Vectorised environments of MPE2 (multi-particle environments)."""
