"""Served versions: alias watcher, version cache, hot swap, canary and shadow."""
