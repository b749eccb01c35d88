"""Schedules: who meets whom, how often, in which order. Pure: the same arguments give the same schedule and id.

Two contestants meet at a time, in leagues of any number of sides (see match.py). The order goes round by round, every
pairing once in each, so that any prefix of a schedule is balanced.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

from league.config import GateConfig, LeagueConfig
from league.errors import EnvironmentMismatch
from league.interface import Interface, digest
from league.results.records import Schedule, Scoring
from league.seeds import derive

Pairing = tuple[int, ...]


def round_robin(
    config: LeagueConfig, interface: Interface, contestants: Sequence[str], blocks: int, seed: int = 0
) -> Schedule:
    """Every pair of contestants meets in `blocks` matches."""
    pairings = list(combinations(range(len(contestants)), 2))
    return _schedule(config, interface, "round_robin", contestants, pairings, blocks * len(pairings), seed)


def gauntlet(
    config: LeagueConfig,
    interface: Interface,
    challengers: Sequence[str],
    opponents: Sequence[str],
    blocks: int,
    seed: int = 0,
) -> Schedule:
    """Every challenger meets every opponent, but never itself, in `blocks` matches."""
    contestants = list(dict.fromkeys([*challengers, *opponents]))
    number = {ref: i for i, ref in enumerate(contestants)}
    meetings = [(number[a], number[b]) for a in challengers for b in opponents if a != b]
    pairings = list({frozenset(pair): pair for pair in meetings}.values())
    return _schedule(config, interface, "gauntlet", contestants, pairings, blocks * len(pairings), seed)


def verdict(
    config: LeagueConfig,
    interface: Interface,
    challenger: str,
    champion: str,
    gate: GateConfig | None = None,
    seed: int = 0,
) -> Schedule:
    """The challenger meets the champion in up to `gate.max_blocks` matches; its id depends on the gate's
    settings too.

    gate: by default the league's.
    """
    gate = gate or config.gate
    schedule = _schedule(config, interface, "verdict", [challenger, champion], [(0, 1)], gate.max_blocks, seed)
    return replace(schedule, id=f"{schedule.id}-{digest(gate.model_dump(mode='json'))[:8]}")


def beside(
    config: LeagueConfig, interface: Interface, kind: str, verdict: Schedule, opponent: str, blocks: int
) -> Schedule:
    """The challenger of a verdict meets somebody in up to `blocks` matches of that verdict's own, with seeds that no
    other schedule has.

    kind: `anchor` or `confirmation`.
    """
    contestants = [verdict.contestants[0], opponent]
    return _schedule(config, interface, kind, contestants, [(0, 1)], blocks, verdict.seed, of=verdict.id)


def scoring(interface: Interface) -> Scoring:
    """`game` where there are several sides and all are alike, by the spaces of their agents; else `side`.

    Chess has two alike sides, an adversary and those whom it works against are unlike, a team is one side.
    """
    kinds = {
        tuple(sorted(digest(interface.agents[agent].model_dump(mode="json")) for agent in agents))
        for agents in interface.sides.values()
    }
    return "game" if len(interface.sides) > 1 and len(kinds) == 1 else "side"


def _schedule(
    config: LeagueConfig,
    interface: Interface,
    kind: str,
    contestants: Sequence[str],
    pairings: Sequence[Pairing],
    length: int,
    seed: int,
    of: str | None = None,
) -> Schedule:
    if not pairings:
        raise EnvironmentMismatch(f"a schedule of league {config.league} needs two contestants that can meet")
    content: dict[str, Any] = {
        "environment": config.environment.digest(),
        "sides": {side: list(agents) for side, agents in interface.sides.items()},
        "scoring": scoring(interface),
        "opening_plies": config.play.opening_plies,
        "contestants": list(contestants),
        "pairings": [list(pairing) for pairing in pairings],
        "length": length,
        "seed": seed,
    }
    if of is not None:
        content |= {"kind": kind, "of": of}
    name = digest(content)
    return Schedule(
        id=f"{config.league}-{kind}-{name[:16]}",
        league=config.league,
        kind=kind,
        seed=derive(seed, name),
        environment_digest=config.environment.digest(),
        sides=tuple(interface.sides),
        contestants=tuple(contestants),
        pairings=tuple(pairings),
        length=length,
        opening_plies=config.play.opening_plies,
        scoring=scoring(interface),
    )
