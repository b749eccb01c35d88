"""What happens to a batch of episodes in the learner: advantages, minibatches, losses."""
