"""Environments behind one batched stepping protocol."""
