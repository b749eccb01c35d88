"""What the ledger admits: a match that its schedule asked for, whole and consistent. Pure."""

import math
from typing import get_args

from league.errors import LedgerRefusal
from league.results.records import GAMES_PER_BLOCK, Game, Match, Reason, Schedule
from league.results.scoring import scores


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
    if len(match.games) != GAMES_PER_BLOCK:
        raise _refusal(match, f"it has {len(match.games)} games, expected {GAMES_PER_BLOCK}")
    for index, game in enumerate(match.games):
        _admit_game(match, schedule, index, game)
    returns = [game.returns for game in match.games]
    forfeits = [{forfeit.contestant for forfeit in game.forfeits} for game in match.games]
    for index, expected_scores in enumerate(scores(returns, schedule.scoring, forfeits)):
        if match.games[index].scores != expected_scores:
            given, ground = match.games[index].scores, "forfeits" if any(forfeits) else "returns"
            raise _refusal(match, f"game {index} has the scores {given}, but its {ground} say {expected_scores}")


def _admit_game(match: Match, schedule: Schedule, index: int, game: Game) -> None:
    seating = schedule.seating_at(match.position, index)
    if game.sides != seating:
        raise _refusal(match, f"game {index} has its sides played by {game.sides}, expected {seating}")
    if game.seed != match.seed:
        raise _refusal(match, f"game {index} has the seed {game.seed}, not the block's")
    # A step has an action of each agent that must act: one in turn-based games, several in simultaneous ones.
    is_whole = len(game.opening) >= schedule.opening_plies and bool(game.opening) == bool(schedule.opening_plies)
    if not is_whole or game.opening != match.games[0].opening:
        raise _refusal(match, f"game {index} has another opening than the block's {schedule.opening_plies} steps")
    finite = [value is not None and math.isfinite(value) for value in game.returns]
    if finite != [contestant in seating for contestant in range(len(match.contestants))]:
        raise _refusal(match, f"game {index} needs a finite return of each contestant that played, not {game.returns}")
    for forfeit in game.forfeits:
        if forfeit.contestant not in seating:
            raise _refusal(match, f"game {index} is forfeited by contestant {forfeit.contestant}, who did not play it")
        if forfeit.reason not in get_args(Reason):
            raise _refusal(match, f"game {index} is forfeited for a reason that there is not: {forfeit.reason!r}")
    if len({forfeit.contestant for forfeit in game.forfeits}) < len(game.forfeits):
        raise _refusal(match, f"game {index} is forfeited twice by one contestant")


def _refusal(match: Match, reason: str) -> LedgerRefusal:
    return LedgerRefusal(f"match {match.id} is refused: {reason}")
