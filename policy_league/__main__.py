"""`python -m policy_league`: the `league` command."""

from policy_league.cli.main import run

run()
