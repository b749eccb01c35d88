"""Learners: advantages, minibatches, targets, losses and gradient steps."""
