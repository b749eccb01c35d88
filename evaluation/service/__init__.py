"""The evaluation service: a Serve deployment with subprocesses for evaluations, games and snapshots."""
