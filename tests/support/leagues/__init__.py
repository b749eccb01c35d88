"""Leagues for tests: versions, matches, verdicts and training runs."""
