"""The kernel: what a league, a checkpoint version, a policy and a result are."""
