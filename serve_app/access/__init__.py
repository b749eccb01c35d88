"""Access control: API keys, permissions, rate limits, load shedding, errors and the access log."""
