"""Matches for the ledger."""

from league.results.records import Game, Match, Schedule
from tests.support.leagues.registries import LEAGUE, config

SCHEDULE = Schedule(
    id="tictactoe-round_robin-1",
    league=LEAGUE,
    kind="round_robin",
    seed=2**63 - 1,
    environment_digest=config().environment.digest(),
    game_digest=config().game_digest(),
    sides=("player_1", "player_2"),
    contestants=("tictactoe@1", "tictactoe@2", "script:random"),
    pairings=((0, 1), (0, 2), (1, 2)),
    length=9,
    opening_plies=2,
)


def game(schedule: Schedule, position: int, index: int) -> Game:
    """A game that contestant 0 wins as first player and draws as second, with different moves in each game."""
    won = index == 0
    return Game(
        sides=(index, 1 - index),
        seed=schedule.seed_at(position),
        opening=(position, 1),
        actions=(3, index, position),
        returns=(1.0, -1.0) if won else (0.25, 0.25),
        scores=(1.0, 0.0) if won else (0.5, 0.5),
    )


def play_match(schedule: Schedule, position: int) -> Match:
    return Match(
        id=schedule.match_id(position),
        league=schedule.league,
        schedule=schedule.id,
        position=position,
        contestants=schedule.contestants_at(position),
        seed=schedule.seed_at(position),
        environment_digest=schedule.environment_digest,
        games=(game(schedule, position, 0), game(schedule, position, 1)),
    )
