"""Servers for tests: replicas with and without Ray, PostgreSQL, and servers under load."""
