"""The course of an evaluation: the schedules that it plays one after another, and where it may be looked at. Pure.

A round robin, a challenge and cross-play are one schedule. An adaptive tournament is one schedule after another, each
drawn up from the results of those before it. What comes next is a function of the matches so far, so that a run that
was killed finds in the ledger what it has played and goes on there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from evaluation.schedule import adaptive_name, adaptive_round, adaptive_rounds, cross_play, gauntlet, round_robin
from league.config import LeagueConfig
from league.errors import EnvironmentMismatch
from league.interface import Interface
from league.results.records import Match, Schedule

Kind = Literal["round_robin", "gauntlet", "adaptive", "cross_play"]

DEFAULT_BLOCKS = 32
"""Matches of each pair in a round robin whose end nothing else says."""

MOST_BLOCKS = 10_000
"""Matches of each pair where a budget or a precision says when to end."""

ADAPTIVE_SHARE = 4
"""An adaptive tournament plays a quarter of the matches of a round robin: see docs/statistics.md."""

LOOKS = 1.1
"""A look at the ratings is worth it when there are a tenth more matches than at the look before."""


@dataclass(frozen=True, slots=True)
class Course:
    """What is to be played.

    name: the id of its schedule, or what those of its rounds begin with.
    following: the matches so far, which end where a schedule does → the next schedule; None behind the last one.
    length: matches at most, all schedules together.
    rounds: after how many matches everybody has had a turn, endlessly.
    """

    name: str
    contestants: tuple[str, ...]
    following: Callable[[Sequence[Match]], Schedule | None]
    length: int
    rounds: Callable[[], Iterator[int]]

    def looks(self) -> Iterator[int]:
        """The numbers of matches at which the ratings are looked at: ends of rounds, ever farther apart."""
        last = 0
        for end in itertools.takewhile(lambda end: end <= self.length, self.rounds()):
            if end >= LOOKS * last:
                yield end
                last = end


def draw_up(
    config: LeagueConfig,
    interface: Interface,
    kind: Kind,
    contestants: Sequence[str],
    against: Sequence[str] = (),
    blocks: int = DEFAULT_BLOCKS,
    seed: int = 0,
) -> Course:
    """The course of one kind between `contestants`; in a gauntlet each of them meets those of `against`.

    Raises EnvironmentMismatch for contestants that cannot meet, and for cross-play where there is no team.
    """
    match kind:
        case "round_robin":
            return _fixed(round_robin(config, interface, contestants, blocks, seed))
        case "gauntlet":
            return _fixed(gauntlet(config, interface, contestants, against, blocks, seed, kind="challenge"))
        case "cross_play":
            return _fixed(cross_play(config, interface, contestants, blocks, seed))
        case "adaptive":
            return _adaptive(config, interface, contestants, blocks, seed)


def _fixed(schedule: Schedule) -> Course:
    turn = len(schedule.pairings)
    return Course(
        name=schedule.id,
        contestants=schedule.contestants,
        following=lambda matches: None if matches else schedule,
        length=schedule.length,
        rounds=lambda: itertools.count(turn, turn),
    )


def _adaptive(config: LeagueConfig, interface: Interface, contestants: Sequence[str], blocks: int, seed: int) -> Course:
    if len(contestants) < 2:
        raise EnvironmentMismatch(f"a schedule of league {config.league} needs two contestants that can meet")
    shortest = next(adaptive_rounds(interface, len(contestants)))
    return Course(
        name=adaptive_name(config, interface, contestants, seed),
        contestants=tuple(contestants),
        following=lambda matches: adaptive_round(
            config, interface, contestants, [match.result() for match in matches], seed
        ),
        length=max(shortest, math.ceil(blocks * math.comb(len(contestants), 2) / ADAPTIVE_SHARE)),
        rounds=lambda: adaptive_rounds(interface, len(contestants)),
    )
