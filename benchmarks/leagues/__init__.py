"""Leagues that benchmarks serve and evaluate."""
