"""Vectorised environments: faster implementations of PettingZoo environments, equal to them bit by bit."""
