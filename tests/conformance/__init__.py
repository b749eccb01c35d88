"""Reusable checks: whoever implements a contract calls the assertion that the project itself uses."""
