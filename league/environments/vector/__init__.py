"""Vectorised environments: faster implementations of PettingZoo environments by array operations."""
