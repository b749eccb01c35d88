"""Served versions: registry watcher, version cache, hot swap, canary and shadow."""
