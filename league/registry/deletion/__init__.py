"""Deletes files that nothing needs any more, and versions and leagues on request."""
