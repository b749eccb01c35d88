"""Clients for tests: of our API, of the inference protocol, of events, and a browser."""
