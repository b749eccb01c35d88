"""Tree search over many games at once, on vectorised environments."""
