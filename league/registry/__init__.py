"""The registry: leagues, checkpoint versions, aliases, verdicts, evaluations and training runs."""
