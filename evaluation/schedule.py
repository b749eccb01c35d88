"""Schedules: who meets whom, how often, in which order. Pure: the same arguments give the same schedule and id.

Two contestants meet at a time, in leagues of any number of sides (see match.py). The order goes round by round, every
pairing once in each, so that any prefix of a schedule is balanced. An adaptive tournament is a sequence of schedules,
each of which follows from the results of those before it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, combinations_with_replacement
from typing import Any

from evaluation import adaptive
from league.config import GateConfig, LeagueConfig
from league.errors import ConfigError, EnvironmentMismatch
from league.interface import Interface, digest
from league.results.records import GAMES_PER_BLOCK, BlockResult, Schedule, Scoring
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
    kind: str = "gauntlet",
) -> Schedule:
    """Every challenger meets every opponent, but never itself, in `blocks` matches.

    kind: `gauntlet` is what a night plays for the rating of a new version, `challenge` what somebody asked for.
    """
    contestants = list(dict.fromkeys([*challengers, *opponents]))
    number = {ref: i for i, ref in enumerate(contestants)}
    meetings = [(number[a], number[b]) for a in challengers for b in opponents if a != b]
    pairings = list({frozenset(pair): pair for pair in meetings}.values())
    return _schedule(config, interface, kind, contestants, pairings, blocks * len(pairings), seed)


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


def cross_play(
    config: LeagueConfig, interface: Interface, contestants: Sequence[str], blocks: int, seed: int = 0
) -> Schedule:
    """Every pair of contestants, and each with itself, plays `blocks` matches in one team.

    The sides are the team's agents: one of them is played by one contestant, the others by the other.
    Raises EnvironmentMismatch unless the league has one side of several agents.
    """
    if len(interface.sides) != 1 or len(interface.agents) < 2:
        raise EnvironmentMismatch(
            f"cross-play mixes the agents of one team, but league {config.league} has {len(interface.sides)} side(s)"
            f" and {len(interface.agents)} agent(s)"
        )
    if len(contestants) < 2:
        raise EnvironmentMismatch(f"cross-play in league {config.league} needs two contestants")
    pairings = list(combinations_with_replacement(range(len(contestants)), 2))
    length = blocks * len(pairings)
    return _schedule(config, interface.apart(), "cross_play", contestants, pairings, length, seed, "team")


def adaptive_round(
    config: LeagueConfig,
    interface: Interface,
    contestants: Sequence[str],
    results: Sequence[BlockResult],
    seed: int = 0,
) -> Schedule:
    """The round of an adaptive tournament that follows `results`, which are those of all rounds before it.

    Its id says which round of which tournament it is, not who meets in it: that is in the ledger once it has begun, and
    holds there even if another machine rounds a number differently.
    """
    first = _first_round(config, interface, contestants, seed)
    turns, games = _turns(interface), GAMES_PER_BLOCK if len(interface.sides) > 1 else 1
    pairings: Sequence[Pairing] = first.pairings
    if results:
        tally = adaptive.tally({ref: i for i, ref in enumerate(contestants)}, results)
        size = adaptive.round_size(len(contestants), len(results) // turns)
        pairings = adaptive.choose(*tally, size, comparisons=games * turns)
    return replace(
        first,
        id=f"{first.id}-{len(results)}",
        seed=derive(first.seed, len(results)),
        pairings=tuple(pairings),
        length=turns * len(pairings),
    )


def adaptive_name(config: LeagueConfig, interface: Interface, contestants: Sequence[str], seed: int = 0) -> str:
    """What the ids of all rounds of an adaptive tournament begin with."""
    return _first_round(config, interface, contestants, seed).id


def adaptive_rounds(interface: Interface, contestants: int) -> Iterator[int]:
    """How many matches have been played at the end of each round of an adaptive tournament."""
    turns, played = _turns(interface), 0
    while True:
        played += adaptive.round_size(contestants, played) if played else len(adaptive.ring(contestants, 0))
        yield turns * played


def _first_round(config: LeagueConfig, interface: Interface, contestants: Sequence[str], seed: int) -> Schedule:
    pairings = adaptive.ring(len(contestants), seed)
    return _schedule(config, interface, "adaptive", contestants, pairings, _turns(interface) * len(pairings), seed)


def _turns(interface: Interface) -> int:
    """How often a pairing of an adaptive round is played: the seat goes round where there are more than two sides."""
    return len(interface.sides) if len(interface.sides) > 2 else 1


def scoring(config: LeagueConfig, interface: Interface) -> Scoring:
    """What `play.scoring` says; else `game` where there are several sides and all are alike, by the spaces of their
    agents, and otherwise `side`.

    Chess has two alike sides, an adversary and those whom it works against are unlike, a team is one side. Raises
    ConfigError for `game` where nobody else is in the same game.
    """
    if config.play.scoring is not None:
        if config.play.scoring == "game" and len(interface.sides) == 1:
            raise ConfigError("play.scoring: game compares sides of one game, and there is one side only: leave it out")
        return config.play.scoring
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
    compared: Scoring | None = None,
    of: str | None = None,
) -> Schedule:
    compared = compared or scoring(config, interface)
    if not pairings:
        raise EnvironmentMismatch(f"a schedule of league {config.league} needs two contestants that can meet")
    content: dict[str, Any] = {
        "environment": config.environment.digest(),
        "sides": {side: list(agents) for side, agents in interface.sides.items()},
        "scoring": compared,
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
        scoring=compared,
    )
