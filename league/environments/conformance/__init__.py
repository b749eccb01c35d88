"""The checks of `league check-env`: whether an environment does what training and matches need."""
