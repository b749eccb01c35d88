"""What training records in the registry: runs, the strength of their versions, and nights of training."""
