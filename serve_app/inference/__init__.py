"""Execution of inference requests: action requests and streams."""
