"""League configuration → RLlib → published checkpoint versions."""
