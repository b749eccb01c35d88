"""The `league` command, the bundled configurations and the example environments."""
