"""A recorded game for somebody who leafs through it: some of its steps with their pictures, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass

from evaluation.exhibition import Moment
from evaluation.pictures import data_uri
from evaluation.report import Document
from evaluation.shows import Show
from evaluation.steps import LARGEST, Step, step_of
from league.environments.stepping import BatchedEnvironment
from league.games import Recording
from league.results.records import Match


@dataclass(frozen=True, slots=True)
class Recorded(Document):
    """cast: agent → who played it. length: steps of the whole game. steps: those that were asked for.

    returns: agent → return. forfeits: by whom, as whom and why. fault: why the game cannot be played again, in a
    sentence; then there are no steps.
    """

    match: str
    game: int
    cast: dict[str, str]
    length: int
    every: int
    steps: tuple[Step, ...]
    returns: dict[str, float]
    forfeits: tuple[dict[str, str], ...]
    fault: str | None


def leaf_through(show: Show, match: Match, asked: Recording, environment: BatchedEnvironment, draws: bool) -> Recorded:
    """The steps that were asked for. The game is played to its end whatever they are: that is what proves it.

    match: the record. draws: whether `environment`, of one copy, gives pictures.
    """
    steps: list[Step] = []
    last: Moment | None = None
    fault = None
    try:
        for last in show.play(environment):
            if asked.wants(last.step, last.is_over):
                picture = data_uri(environment.render(0), LARGEST) if draws else None
                steps.append(step_of(last, show.cast, show.interface, picture, show.opening))
        assert last is not None, "a game has a beginning"
    except Exception as error:  # an environment's own code: whatever it raises, the game is told as far as it goes
        steps, last = [], None
        fault = " ".join(str(error).split()) or type(error).__name__
    return Recorded(
        match=match.id,
        game=asked.game,
        cast=dict(show.cast),
        length=0 if last is None else last.step,
        every=asked.every,
        steps=tuple(steps),
        returns={} if last is None else last.returns,
        forfeits=_forfeits(match, asked.game),
        fault=fault,
    )


def _forfeits(match: Match, game: int) -> tuple[dict[str, str], ...]:
    return tuple(
        {"agent": each.agent, "ref": match.contestants[each.contestant], "reason": each.reason}
        for each in match.games[game].forfeits
    )
