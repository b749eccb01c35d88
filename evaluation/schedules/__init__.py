"""Schedules of matches: block design, adaptive pairing and stopping rules."""
