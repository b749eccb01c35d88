"""Wrappers of SuperSuit and of the user, applied to an environment, or to the observations of a batch."""
