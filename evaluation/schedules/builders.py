"""Builds schedules: who plays whom, how often and in which order. Pure and deterministic.

A match is one block: two games with one seed and one opening between two contestants. In the first game, contestant 0
has one side (the *seat*) and contestant 1 has all others. In the second game they swap. Both contestants therefore get
the advantage of a seat or an opening once:

| sides | the two games of a block                                                                           |
|-------|----------------------------------------------------------------------------------------------------|
| two   | A against B, and B against A                                                                       |
| more  | A among Bs, and B among As in the same seat; the seat rotates with the rounds of the schedule       |
| one   | A alone, and B alone: a team, or a single agent                                                    |

league/results/scoring.py defines how games are scored.

Matches are ordered in rounds, each with every pairing once, so that every prefix of a schedule is balanced. An adaptive
tournament is a sequence of schedules, each computed from the results of the previous ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evaluation.schedules import adaptive_pairing
from league.conditions import ActionSelection, action_selection
from league.config.gate import GateConfig
from league.config.league import LeagueConfig
from league.errors import EnvironmentMismatch
from league.interface import Interface, digest
from league.random.seeds import derive
from league.refs import ScriptRef
from league.results.records import GAMES_PER_BLOCK, BlockResult, Schedule, Scoring
from league.results.scoring import scoring

ANCHOR = str(ScriptRef("random"))
"""The contestant whose rating is 0."""


@dataclass(frozen=True, slots=True)
class GamePlans:
    """Games of a schedule, in columns. A game is identified by its row.

    Attributes:
        positions: Position of the match of each game, (g,).
        indices: Number of the game in its block, (g,).
        seeds: Seed of the environment, equal in both games of a block, (g,).
        contestants: The match's contestants, as indices into those of the schedule, (g, 2).
        sides: Who controls each side, as an index into the match's contestants, (g, sides).
    """

    positions: NDArray[np.int64]
    indices: NDArray[np.int64]
    seeds: NDArray[np.int64]
    contestants: NDArray[np.int64]
    sides: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.positions)


def game_plans(schedule: Schedule, positions: Sequence[int]) -> GamePlans:
    """Return the games of the matches at `positions` of `schedule`, in order."""
    game_positions = np.repeat(np.asarray(positions, dtype=np.int64), GAMES_PER_BLOCK)
    indices = np.tile(np.arange(GAMES_PER_BLOCK), len(positions))
    pairings = np.array(schedule.pairings, dtype=np.int64)
    seats = np.repeat([schedule.seat_at(position) for position in positions], GAMES_PER_BLOCK)
    has_seat = np.arange(len(schedule.sides)) == seats[:, np.newaxis]
    return GamePlans(
        positions=game_positions,
        indices=indices,
        seeds=np.repeat(np.array(schedule.seeds_at(positions), dtype=np.int64), GAMES_PER_BLOCK),
        contestants=pairings[game_positions % len(pairings)],
        sides=np.where(has_seat, indices[:, np.newaxis], 1 - indices[:, np.newaxis]),
    )


Pairing = tuple[int, ...]


def round_robin(
    config: LeagueConfig, interface: Interface, contestants: Sequence[str], blocks: int, seed: int = 0
) -> Schedule:
    """Every pair of contestants plays `blocks` matches."""
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
    """Every challenger plays `blocks` matches against every opponent except itself.

    kind: `gauntlet` for the rating of a new version in a nightly run, `challenge` for requested evaluations.
    """
    contestants = list(dict.fromkeys([*challengers, *opponents]))
    number = {ref: i for i, ref in enumerate(contestants)}
    meetings = [(number[a], number[b]) for a in challengers for b in opponents if a != b]
    pairings = list({frozenset(pair): pair for pair in meetings}.values())
    return _schedule(config, interface, kind, contestants, pairings, blocks * len(pairings), seed)


def verdict(
    config: LeagueConfig,
    interface: Interface,
    candidate: str,
    champion: str,
    gate: GateConfig | None = None,
    seed: int = 0,
) -> Schedule:
    """The candidate plays up to `gate.max_blocks` matches against the champion.

    The id depends on the gate's settings, too.
    gate: by default that of the league.
    """
    gate = gate or config.gate
    schedule = _schedule(config, interface, "verdict", [candidate, champion], [(0, 1)], gate.max_blocks, seed)
    return replace(schedule, id=f"{schedule.id}-{digest(gate.model_dump(mode='json'))[:8]}")


def companion(
    config: LeagueConfig, interface: Interface, kind: str, verdict: Schedule, opponent: str, blocks: int
) -> Schedule:
    """The candidate of a verdict plays up to `blocks` matches against another opponent, with seeds of this verdict.

    kind: `anchor` or `confirmation`.
    """
    contestants = [verdict.contestants[0], opponent]
    return _schedule(config, interface, kind, contestants, [(0, 1)], blocks, verdict.seed, of=verdict.id)


def paired_test(
    config: LeagueConfig,
    interface: Interface,
    kind: str,
    verdict: Schedule,
    pairs: Sequence[tuple[str, str]],
    rounds: int,
) -> Schedule:
    """The candidate of a verdict and its champion play up to `rounds` matches each against the opponents of a pair.

    Their matches alternate, the candidate's first. All matches of a round have the same seed, opening and seats.
    kind: `anchor` or `exploiter`, with one opponent of both, or `exploitability`.
    pairs: opponent of the candidate and opponent of the champion.
    """
    of_candidate, of_champion = zip(*pairs, strict=True)
    contestants = list(dict.fromkeys([*verdict.contestants, *of_candidate, *of_champion]))
    number = {ref: i for i, ref in enumerate(contestants)}
    pairings = [pairing for first, second in pairs for pairing in ((0, number[first]), (1, number[second]))]
    length, seed = rounds * len(pairings), verdict.seed
    schedule = _schedule(config, interface, kind, contestants, pairings, length, seed, of=verdict.id)
    return replace(schedule, common_seeds=True)


def strength_test(config: LeagueConfig, interface: Interface, version: str, opponent: str, blocks: int) -> Schedule:
    """A version that was published during training plays `blocks` matches against an opponent.

    The seeds are equal for all versions and opponents of a league, so that scores differ less by chance.
    """
    schedule = _schedule(config, interface, "strength", [version, opponent], [(0, 1)], blocks, seed=0)
    return replace(schedule, seed=derive(0, "strength"))


def cross_play(
    config: LeagueConfig, interface: Interface, contestants: Sequence[str], blocks: int, seed: int = 0
) -> Schedule:
    """Every pair of contestants, and each with itself, plays `blocks` matches in one team.

    The sides are the team's agents: one contestant controls one of them, the other contestant the others.
    Raises EnvironmentMismatch unless the league has one side with several agents.
    """
    if len(interface.sides) != 1 or len(interface.agents) < 2:
        raise EnvironmentMismatch(
            f"cross-play mixes the agents of one team, but league {config.league} has {len(interface.sides)} side(s)"
            f" and {len(interface.agents)} agent(s)"
        )
    if len(contestants) < 2:
        raise too_few(config.league, contestants)
    pairings = list(combinations_with_replacement(range(len(contestants)), 2))
    length, actions = blocks * len(pairings), action_selection(config, interface)
    return _schedule(config, interface.apart(), "cross_play", contestants, pairings, length, seed, "team", actions)


def adaptive_round(
    config: LeagueConfig,
    interface: Interface,
    contestants: Sequence[str],
    results: Sequence[BlockResult],
    seed: int = 0,
) -> Schedule:
    """The round of an adaptive tournament that follows `results`, the results of all earlier rounds.

    The id identifies the round and the tournament, but not the pairings. These are in the ledger once the round has
    begun, and stay valid if another machine rounds numbers differently.
    """
    first = _first_round(config, interface, contestants, seed)
    turns, games = _turns(interface), GAMES_PER_BLOCK if len(interface.sides) > 1 else 1
    pairings: Sequence[Pairing] = first.pairings
    if results:
        tally = adaptive_pairing.tally({ref: i for i, ref in enumerate(contestants)}, results)
        size = adaptive_pairing.round_size(len(contestants), len(results) // turns)
        pairings = adaptive_pairing.choose(*tally, size, comparisons=games * turns)
    return replace(
        first,
        id=f"{first.id}-{len(results)}",
        seed=derive(first.seed, len(results)),
        pairings=tuple(pairings),
        length=turns * len(pairings),
    )


def adaptive_name(config: LeagueConfig, interface: Interface, contestants: Sequence[str], seed: int = 0) -> str:
    """Common prefix of the ids of all rounds of an adaptive tournament."""
    return _first_round(config, interface, contestants, seed).id


def adaptive_rounds(interface: Interface, contestants: int) -> Iterator[int]:
    """Number of matches at the end of each round of an adaptive tournament."""
    turns, played = _turns(interface), 0
    while True:
        played += (
            adaptive_pairing.round_size(contestants, played) if played else len(adaptive_pairing.ring(contestants, 0))
        )
        yield turns * played


def _first_round(config: LeagueConfig, interface: Interface, contestants: Sequence[str], seed: int) -> Schedule:
    pairings = adaptive_pairing.ring(len(contestants), seed)
    return _schedule(config, interface, "adaptive", contestants, pairings, _turns(interface) * len(pairings), seed)


def _turns(interface: Interface) -> int:
    """How often an adaptive round plays a pairing: once per seat if there are more than two sides."""
    return len(interface.sides) if len(interface.sides) > 2 else 1


def too_few(league: str, contestants: Sequence[str]) -> EnvironmentMismatch:
    """Return the error for a schedule without a pair of contestants."""
    different = list(dict.fromkeys(contestants))
    summary = f"{len(different)}: {', '.join(different)}" if different else "none"
    return EnvironmentMismatch(f"a schedule of league {league} needs at least two contestants, got {summary}")


def _schedule(
    config: LeagueConfig,
    interface: Interface,
    kind: str,
    contestants: Sequence[str],
    pairings: Sequence[Pairing],
    length: int,
    seed: int,
    compared: Scoring | None = None,
    actions: ActionSelection | None = None,
    of: str | None = None,
) -> Schedule:
    compared = compared or scoring(config, interface)
    actions = actions or action_selection(config, interface)
    if not pairings:
        raise too_few(config.league, contestants)
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
    if actions != "greedy":  # otherwise the ids of the schedules that were created before there was a choice
        content["actions"] = actions
    game = config.game_digest()
    return Schedule(
        id=f"{config.league}-{kind}-{digest(content | {'game': game})[:16]}",
        league=config.league,
        kind=kind,
        # Without the game, so that the same games are played before and after a change of the code.
        seed=derive(seed, digest(content)),
        environment_digest=config.environment.digest(),
        game_digest=game,
        sides=tuple(interface.sides),
        contestants=tuple(contestants),
        pairings=tuple(pairings),
        length=length,
        opening_plies=config.play.opening_plies,
        scoring=compared,
        actions=actions,
    )
