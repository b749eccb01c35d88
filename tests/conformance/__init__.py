"""Reusable conformance checks: an implementation of a contract calls the assertion that the project itself uses."""
