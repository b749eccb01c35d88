"""Environments to learn from and to start from."""
