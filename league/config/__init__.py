"""Configuration of a league, read from one YAML file. Each section is a frozen model that rejects unknown keys."""
