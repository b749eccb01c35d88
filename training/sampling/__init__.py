"""Sampling: an EnvRunner on the league's lockstep stepping, opponents, recorders, exploration."""
