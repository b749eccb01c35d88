"""Vectorised environments: many copies stepped by array operations."""
