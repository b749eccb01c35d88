"""The `league` command: parses, calls one function, prints."""
