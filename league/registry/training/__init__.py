"""What training records in the registry: runs, and nights of training."""
