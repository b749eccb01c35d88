"""Networks and callbacks to start from: docs/extending.md."""
