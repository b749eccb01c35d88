"""The promotion gate: sequential tests, verdicts and their verification, nightly runs."""
