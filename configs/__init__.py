"""Bundled league configurations."""
