"""Recorded games to page through: the actions of each step, with a small image if the environment renders."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

from evaluation.matches.game_records import Upset
from evaluation.playback.captions import Caption, Captions, Line
from evaluation.playback.replay import recorded_game
from evaluation.playback.video import data_uri, render_modes
from evaluation.results import Document
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import one_line
from league.registry.registry import Registry

MOST_STEPS = 240
"""Steps per game. Longer games keep every second, fourth, … step."""
MOST_BYTES = 3_000_000
"""Total size of all images of one report, as data URIs."""
LARGEST = 256
"""Longer side of an image, in pixels."""


@dataclass(frozen=True, slots=True)
class FlipbookStep(Document):
    """One step: the actions as text, and the image after it as a data URI or None."""

    step: int
    did: str
    picture: str | None


@dataclass(frozen=True, slots=True)
class Flipbook(Document):
    """An upset; `better`, `other`, `expected` and `score` as in an Upset.

    players: agent → reference. steps: every `every`-th of `length`, including the first and the last.
    returns: agent → return. fault: why it cannot be replayed; `steps` is empty then.
    """

    match: str
    game: int
    better: str
    other: str
    expected: float
    score: float
    players: dict[str, str]
    steps: tuple[FlipbookStep, ...]
    every: int
    length: int
    returns: dict[str, float]
    fault: str | None


def flipbooks(registry: Registry, league: str, upsets: Sequence[Upset], pictures: bool) -> tuple[Flipbook, ...]:
    """Replay games of a league from their seeds in one environment. Games that fail have a fault."""
    if not upsets:
        return ()
    try:
        config = registry.leagues.get(league).config.environment
        draws = pictures and "rgb_array" in render_modes(config)
        environment = stock_stepping(config, 1, render_mode="rgb_array" if draws else None)
    except Exception as error:  # third-party code can raise anything; the rest of the report stays valid
        return tuple(_faulty(upset, error) for upset in upsets)
    room = MOST_BYTES // len(upsets) if draws else 0
    with closing(environment):
        return tuple(_flipbook(registry, upset, environment, room) for upset in upsets)


def _flipbook(registry: Registry, upset: Upset, environment: BatchedEnvironment, room: int) -> Flipbook:
    """room: bytes for its images; 0 for none."""
    try:
        source = recorded_game(upset.match, upset.game, registry)
        captions, kept, last = Captions(source.title, source.interface, source.controllers), _Kept(room), None
        for last in source.play(environment):
            caption = captions.of(last)
            did = _words(caption, is_opening=0 < last.step <= source.opening)
            if kept.wants(last.step) or last.is_over:
                picture = data_uri(environment.render(0), LARGEST) if room else None
                kept.add(FlipbookStep(last.step, did, picture), is_last=last.is_over)
        assert last is not None, "a game has at least one step"
    except Exception as error:  # as above
        return _faulty(upset, error)
    return Flipbook(
        match=upset.match,
        game=upset.game,
        better=upset.better,
        other=upset.other,
        expected=upset.expected,
        score=upset.score,
        players=dict(source.controllers),
        steps=tuple(kept.steps),
        every=kept.every,
        length=last.step,
        returns=last.returns,
        fault=None,
    )


def _faulty(upset: Upset, error: Exception) -> Flipbook:
    return Flipbook(
        match=upset.match,
        game=upset.game,
        better=upset.better,
        other=upset.other,
        expected=upset.expected,
        score=upset.score,
        players={},
        steps=(),
        every=1,
        length=0,
        returns={},
        fault=one_line(error),
    )


class _Kept:
    """Steps of a game of unknown length. Every second one is dropped when they become too many or too large."""

    def __init__(self, room: int) -> None:
        self._room = room
        self.every = 1
        self.steps: list[FlipbookStep] = []

    def wants(self, step: int) -> bool:
        return step % self.every == 0

    def add(self, step: FlipbookStep, is_last: bool) -> None:
        self.steps.append(step)
        while self._are_too_many():
            self.every *= 2
            self.steps = [
                kept_step for kept_step in self.steps if self.wants(kept_step.step) or (is_last and kept_step is step)
            ]

    def _are_too_many(self) -> bool:
        size = sum(len(step.picture or "") for step in self.steps)
        return len(self.steps) > 2 and (len(self.steps) > MOST_STEPS or size > self._room)


def _words(caption: Caption, is_opening: bool) -> str:
    did = "; ".join(_line(line) for line in caption.lines if line.acted)
    return f"{did} (random opening)" if is_opening else did or "start"


def _line(line: Line) -> str:
    """`player_1 plays 4`; for a group, the share of each action."""
    did = line.action or ", ".join(f"{action} ({share:.0%})" for action, share in line.chances)
    return f"{line.name} plays {did}" if did else line.name
