"""Schedules and contestants of tournaments."""

from evaluation.schedules.builders import round_robin
from league.registry.registry import Registry
from league.results.records import Schedule
from tests.support.leagues import tictactoe

STRENGTHS = ({}, {"wins": True}, {"wins": True, "blocks": True, "order": tictactoe.CENTRE_FIRST})


def tournament_schedule(registry: Registry, blocks: int = 6) -> Schedule:
    row = registry.leagues.get(tictactoe.LEAGUE)
    contestants = ["tictactoe@1", "tictactoe@2", "tictactoe@3", "script:random"]
    return round_robin(row.config, row.interface, contestants, blocks)
