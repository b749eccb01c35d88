"""HTTP routes of the server, one module per group of routes."""
