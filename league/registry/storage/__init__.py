"""Storage of the registry: database, artefact store, manifests and locks."""
