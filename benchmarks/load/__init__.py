"""Load generators and misbehaving clients."""
