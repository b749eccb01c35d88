"""Metrics of replicas: counting, reporting to the registry, and the Prometheus format."""
