"""Schedules and games as JSON text, compact and exact: each integer and double comes back as it was."""

import json
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

from league.results.records import Forfeit, Game, Schedule


def dump_schedule(schedule: Schedule) -> str:
    """A schedule by the names of its fields."""
    return _dump({name: getattr(schedule, name) for name in Schedule.__slots__})


def load_schedule(text: str) -> Schedule:
    """The schedule that `dump_schedule` wrote."""
    fields = json.loads(text)
    fields["pairings"] = tuple(tuple(pairing) for pairing in fields["pairings"])
    return Schedule(**fields | {name: tuple(fields[name]) for name in ("sides", "contestants")})


def dump_games(games: Sequence[Game]) -> str:
    """A block: the seed and opening that its games share, and [sides, actions, returns, scores] of each; behind that,
    where it was forfeited, [contestant, agent, reason] of each forfeit."""
    first = games[0]
    return _dump([first.seed, first.opening, [_game(game) for game in games]])


def load_games(text: str) -> tuple[Game, ...]:
    """The block that `dump_games` wrote."""
    seed, opening, games = json.loads(text)
    return tuple(
        Game(
            tuple(sides),
            seed,
            tuple(opening),
            tuple(actions),
            tuple(returns),
            tuple(scores),
            tuple(Forfeit(*forfeit) for forfeit in forfeits),
        )
        for sides, actions, returns, scores, *forfeits in games
    )


def _game(game: Game) -> list[Any]:
    return [
        game.sides,
        game.actions,
        game.returns,
        game.scores,
        *([forfeit.contestant, forfeit.agent, forfeit.reason] for forfeit in game.forfeits),
    ]


def dump_numbers(numbers: Sequence[float]) -> str:
    """A short list."""
    return _dump(numbers)


@lru_cache(maxsize=4096)
def load_numbers(text: str) -> tuple[float, ...]:
    """The list that `dump_numbers` wrote. Games score alike so often that few of these texts are different."""
    return tuple(json.loads(text))


def _dump(document: Any) -> str:
    return json.dumps(document, separators=(",", ":"), allow_nan=False)
