"""What the ledger admits: a match that its schedule asked for, whole and consistent. Pure."""

import math

from league.errors import LedgerRefusal
from league.results.records import Game, Match, Schedule, rotation


def admit(match: Match, schedule: Schedule) -> None:
    """Raise LedgerRefusal, saying what is wrong, unless `match` is what `schedule` asked for."""
    if not 0 <= match.position < schedule.length:
        raise _refusal(match, f"its schedule ends before position {schedule.length}")
    expected = {
        "id": schedule.match_id(match.position),
        "league": schedule.league,
        "schedule": schedule.id,
        "contestants": schedule.contestants_at(match.position),
        "seed": schedule.seed_at(match.position),
        "environment_digest": schedule.environment_digest,
    }
    for name, value in expected.items():
        if getattr(match, name) != value:
            raise _refusal(match, f"its {name} is {getattr(match, name)!r}, but {value!r} in its schedule")
    if len(match.games) != len(schedule.sides):
        raise _refusal(match, f"it has {len(match.games)} games, expected one for each of {len(schedule.sides)} sides")
    for index, game in enumerate(match.games):
        _admit_game(match, schedule, index, game)


def _admit_game(match: Match, schedule: Schedule, index: int, game: Game) -> None:
    if game.sides != rotation(len(schedule.sides), index):
        raise _refusal(match, f"game {index} has its sides played by {game.sides}, not in rotation")
    if game.seed != match.seed:
        raise _refusal(match, f"game {index} has the seed {game.seed}, not the block's")
    if len(game.opening) != schedule.opening_plies or game.opening != match.games[0].opening:
        raise _refusal(match, f"game {index} has another opening than the block's {schedule.opening_plies} moves")
    contestants = len(match.contestants)
    if len(game.returns) != contestants or not all(math.isfinite(value) for value in game.returns):
        raise _refusal(match, f"game {index} needs a finite return of each contestant, not {game.returns}")
    points = len(game.scores) == contestants and all(0 <= score <= 1 for score in game.scores)
    if not points or not math.isclose(sum(game.scores), contestants / 2):
        raise _refusal(match, f"game {index} needs scores that share its points, not {game.scores}")


def _refusal(match: Match, reason: str) -> LedgerRefusal:
    return LedgerRefusal(f"match {match.id} is refused: {reason}")
