"""Scores games and validates matches against their schedule.

If sides are symmetric, opponents are compared within each game: win, draw or loss. If they are not, or if there is one
side, contestants are compared on the same side in the two games of the block, which have the same seed and opening, so
both had the same task. If both play in one team (cross-play), there is no comparison and no score.

A contestant that forfeits a game loses it, whatever its return; if both forfeit, it is a draw. Compared by side, each
comparison uses both games of the block: a contestant that forfeits one of them loses all comparisons, unless the other
contestant forfeits as well.

The scores of a block sum to half their number and swap with the contestants, so equal policies score ½ on average.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, get_args

from league.errors import ConfigError, LedgerConflict
from league.interface import Interface, digest
from league.results.records import GAMES_PER_BLOCK, Game, Match, Reason, Schedule, Scoring

if TYPE_CHECKING:
    from league.config.league import LeagueConfig

Values = tuple[float | None, ...]


def scoring(config: LeagueConfig, interface: Interface) -> Scoring:
    """`play.scoring` of the configuration; by default `game` if there are several sides with equal spaces, else `side`.

    Chess has two equal sides; an adversary and its opponents have different sides; a team is one side.
    Raises ConfigError for `game` with a single side.
    """
    if config.play.scoring is not None:
        if config.play.scoring == "game" and len(interface.sides) == 1:
            raise ConfigError("play.scoring: game compares the sides of a game, but there is only one side: remove it")
        return config.play.scoring
    kinds = {
        tuple(sorted(digest(interface.agents[agent].model_dump(mode="json")) for agent in agents))
        for agents in interface.sides.values()
    }
    return "game" if len(interface.sides) > 1 and len(kinds) == 1 else "side"


def scores(returns: Sequence[Values], scoring: Scoring, forfeits: Sequence[Collection[int]] = ()) -> list[Values]:
    """Score the games of a block.

    Args:
        returns: returns[g][c] is the return of contestant c in game g, None if it did not take part.
        scoring: what returns are compared with.
        forfeits: forfeits[g] are the contestants that forfeited game g; empty if there are none.

    Returns:
        Scores in {0, ½, 1}, indexed like `returns`; None where nothing is compared.
    """
    broken = [frozenset(by) for by in forfeits] or [frozenset[int]() for _ in returns]
    if scoring == "side":
        broken = [frozenset[int]().union(*broken)] * len(returns)
    return list(_scores(tuple(returns), scoring, tuple(broken)))


# Many blocks of a game have the same returns.
@lru_cache(maxsize=4096)
def _scores(returns: tuple[Values, ...], scoring: Scoring, broken: tuple[frozenset[int], ...]) -> tuple[Values, ...]:
    return tuple(
        tuple(_score(returns, game, contestant, scoring, broken[game]) for contestant in range(len(returns[game])))
        for game in range(len(returns))
    )


def _score(
    returns: Sequence[Values], game: int, contestant: int, scoring: Scoring, broken: Collection[int]
) -> float | None:
    own_outcome = returns[game][contestant]
    other_outcome = returns[game if scoring == "game" else 1 - game][1 - contestant]
    if scoring == "team" or own_outcome is None or other_outcome is None:
        return None
    if broken:
        own_outcome, other_outcome = float(contestant not in broken), float(1 - contestant not in broken)
    return 1.0 if own_outcome > other_outcome else 0.5 if own_outcome == other_outcome else 0.0


def admit(match: Match, schedule: Schedule, seed: int | None = None) -> None:
    """Raise LedgerConflict, which names the difference, unless `match` conforms to `schedule`.

    seed: that of the match by the schedule, if it is known.
    """
    if not 0 <= match.position < schedule.length:
        raise _refusal(match, f"its schedule ends before position {schedule.length}")
    expected = schedule.match(match.position, match.games, seed)
    if match != expected:
        for name in Match.__slots__:
            recorded_value, value = getattr(match, name), getattr(expected, name)
            if recorded_value != value:
                raise _refusal(match, f"its {name} is {recorded_value!r}, but {value!r} in its schedule")
    if len(match.games) != GAMES_PER_BLOCK:
        raise _refusal(match, f"it has {len(match.games)} games, expected {GAMES_PER_BLOCK}")
    for index, game in enumerate(match.games):
        _admit_game(match, schedule, index, game)
    returns = [game.returns for game in match.games]
    forfeits = [{forfeit.contestant for forfeit in game.forfeits} for game in match.games]
    for index, expected_scores in enumerate(scores(returns, schedule.scoring, forfeits)):
        if match.games[index].scores != expected_scores:
            recorded_scores, ground = match.games[index].scores, "forfeits" if any(forfeits) else "returns"
            raise _refusal(
                match, f"game {index} has the scores {recorded_scores}, but its {ground} say {expected_scores}"
            )


def _admit_game(match: Match, schedule: Schedule, index: int, game: Game) -> None:
    seating = schedule.seating_at(match.position, index)
    if game.sides != seating:
        raise _refusal(match, f"game {index} has its sides played by {game.sides}, expected {seating}")
    if game.seed != match.seed:
        raise _refusal(match, f"game {index} has the seed {game.seed}, not the block's")
    # A step has one action in turn-based games and several in simultaneous ones.
    is_whole = len(game.opening) >= schedule.opening_plies and bool(game.opening) == bool(schedule.opening_plies)
    if not is_whole or game.opening != match.games[0].opening:
        raise _refusal(match, f"game {index} has another opening than the block's {schedule.opening_plies} steps")
    finite = [value is not None and math.isfinite(value) for value in game.returns]
    if finite != [contestant in seating for contestant in range(len(match.contestants))]:
        raise _refusal(match, f"game {index} needs a finite return of each contestant that played, not {game.returns}")
    for forfeit in game.forfeits:
        if forfeit.contestant not in seating:
            raise _refusal(
                match, f"game {index} is forfeited by contestant {forfeit.contestant}, which did not play it"
            )
        if forfeit.reason not in get_args(Reason):
            raise _refusal(match, f"game {index} has a forfeit with an unknown reason: {forfeit.reason!r}")
    if len({forfeit.contestant for forfeit in game.forfeits}) < len(game.forfeits):
        raise _refusal(match, f"game {index} has two forfeits of one contestant")


def _refusal(match: Match, reason: str) -> LedgerConflict:
    return LedgerConflict(f"match {match.id} is refused: {reason}")
