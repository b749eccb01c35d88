"""A recorded game to leaf through: what was done at each step, with a small picture where the environment draws one."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

from evaluation.captions import Caption, Captions, Line
from evaluation.film import render_modes
from evaluation.pages.surprises import Surprise
from evaluation.pictures import data_uri
from evaluation.report import Document
from evaluation.shows import recorded
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment
from league.registry.registry import Registry

MOST_STEPS = 240
"""Of a game; of a longer one every second, fourth, … is kept."""
MOST_BYTES = 3_000_000
"""Of all pictures of all games of one page, as data URIs."""
LARGEST = 256
"""Pixels of a picture's longer side."""


@dataclass(frozen=True, slots=True)
class Step(Document):
    """One step: what was done, in words, and the picture after it as a data URI, None where there is none."""

    step: int
    did: str
    picture: str | None


@dataclass(frozen=True, slots=True)
class Flipbook(Document):
    """A surprising game; `better`, `other`, `expected` and `score` as in a Surprise.

    cast: agent → who played it. steps: every `every`-th of all `length`, with the first and the last.
    returns: agent → return. fault: why it cannot be played again, in a sentence; then there are no steps.
    """

    match: str
    game: int
    better: str
    other: str
    expected: float
    score: float
    cast: dict[str, str]
    steps: tuple[Step, ...]
    every: int
    length: int
    returns: dict[str, float]
    fault: str | None


def flipbooks(registry: Registry, league: str, surprises: Sequence[Surprise], pictures: bool) -> tuple[Flipbook, ...]:
    """Games of a league, played again from their seeds in one environment.

    A game that cannot be played again has a fault, and the others are shown all the same.
    """
    if not surprises:
        return ()
    try:
        config = registry.league(league).config.environment
        draws = pictures and "rgb_array" in render_modes(config)
        environment = stepping(config, 1, render_mode="rgb_array" if draws else None)
    except Exception as error:  # an environment's own code: whatever it raises, the rest of the report stands
        return tuple(_faulty(surprise, error) for surprise in surprises)
    room = MOST_BYTES // len(surprises) if draws else 0
    with closing(environment):
        return tuple(_flipbook(registry, surprise, environment, room) for surprise in surprises)


def _flipbook(registry: Registry, surprise: Surprise, environment: BatchedEnvironment, room: int) -> Flipbook:
    """room: bytes of its pictures; 0: without any."""
    try:
        show = recorded(surprise.match, surprise.game, registry)
        captions, kept, last = Captions(show.title, show.interface, show.cast), _Kept(room), None
        for last in show.play(environment):
            caption = captions.of(last)
            did = _words(caption, is_opening=0 < last.step <= show.opening)
            if kept.wants(last.step) or last.is_over:
                picture = data_uri(environment.render(0), LARGEST) if room else None
                kept.add(Step(last.step, did, picture), is_last=last.is_over)
        assert last is not None, "a game has a beginning"
    except Exception as error:  # as above
        return _faulty(surprise, error)
    return Flipbook(
        match=surprise.match,
        game=surprise.game,
        better=surprise.better,
        other=surprise.other,
        expected=surprise.expected,
        score=surprise.score,
        cast=dict(show.cast),
        steps=tuple(kept.steps),
        every=kept.every,
        length=last.step,
        returns=last.returns,
        fault=None,
    )


def _faulty(surprise: Surprise, error: Exception) -> Flipbook:
    return Flipbook(
        match=surprise.match,
        game=surprise.game,
        better=surprise.better,
        other=surprise.other,
        expected=surprise.expected,
        score=surprise.score,
        cast={},
        steps=(),
        every=1,
        length=0,
        returns={},
        fault=" ".join(str(error).split()) or type(error).__name__,
    )


class _Kept:
    """Steps of a game of unknown length: when they become too many, or too large, every second one goes."""

    def __init__(self, room: int) -> None:
        self._room = room
        self.every = 1
        self.steps: list[Step] = []

    def wants(self, step: int) -> bool:
        return step % self.every == 0

    def add(self, step: Step, is_last: bool) -> None:
        self.steps.append(step)
        while self._are_too_many():
            self.every *= 2
            self.steps = [each for each in self.steps if self.wants(each.step) or (is_last and each is step)]

    def _are_too_many(self) -> bool:
        size = sum(len(step.picture or "") for step in self.steps)
        return len(self.steps) > 2 and (len(self.steps) > MOST_STEPS or size > self._room)


def _words(caption: Caption, is_opening: bool) -> str:
    did = "; ".join(_line(line) for line in caption.lines if line.acted)
    return f"{did} (random opening)" if is_opening else did or "start"


def _line(line: Line) -> str:
    """`player_1 plays 4`; of a crowd how often each action was taken."""
    did = line.action or ", ".join(f"{action} ({share:.0%})" for action, share in line.chances)
    return f"{line.name} plays {did}" if did else line.name
