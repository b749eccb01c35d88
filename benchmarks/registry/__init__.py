"""Parts of `benchmarks.registry_scale`: PostgreSQL, and many replicas that follow its registry."""
