"""What is kept: leagues, checkpoint versions, aliases, promotions and what replicas serve."""
