"""The versions that a replica answers with: registry watcher, version cache, hot swap, canary and shadow."""
