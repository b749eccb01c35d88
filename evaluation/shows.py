"""What is to be shown: a game between versions and scripts, or one that the ledger has."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from evaluation.exhibition import Moment, exhibit
from evaluation.play import sides_of
from evaluation.replay import replay, seated
from league.config import LeagueConfig
from league.environments.stepping import BatchedEnvironment
from league.errors import InvalidReference, LeagueError
from league.interface import Interface
from league.policies.loading import contestant
from league.policies.pinning import pinned
from league.policies.policy import Policy
from league.refs import CheckpointRef, parse_ref
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match


@dataclass(frozen=True, slots=True)
class Show:
    """A game that can be played before somebody's eyes.

    cast: agent → reference of who plays it. play: environment of one copy → the game, step by step.
    opening: how many of its first steps were random. note: what is to be said of its end beside the returns.
    """

    title: str
    config: LeagueConfig
    interface: Interface
    cast: Mapping[str, str]
    play: Callable[[BatchedEnvironment], Iterator[Moment]]
    opening: int = 0
    note: str | None = None


def between(refs: Sequence[str], registry: Registry, side: str | None = None, seed: int = 0) -> Show:
    """A game of `refs`: the first plays `side` (by default the league's first), the others the other sides in order.

    The last one plays all sides that are left; one alone plays against itself.
    Raises InvalidReference without a version among them, for more of them than sides, and for a side that there is
    not, and what loading them raises.
    """
    versions = [ref for ref in map(parse_ref, refs) if isinstance(ref, CheckpointRef)]
    if not versions:
        raise InvalidReference(
            "name at least one version, such as connect_four@champion: it says which league is shown"
        )
    row = registry.league(versions[0].league)
    names = [pinned(ref, row.slug, registry) for ref in refs]
    players = {ref: contestant(ref, registry, row.interface) for ref in names}
    cast = _cast(names, row.interface, side)
    policies = {agent: players[ref][agent][1] for agent, ref in cast.items()}
    return Show(
        title=f"{row.slug} · seed {seed}",
        config=row.config,
        interface=row.interface,
        cast=cast,
        play=lambda environment: exhibit(environment, policies, seed),
    )


def recorded(match: str, game: int, registry: Registry, chances: bool = False) -> Show:
    """Game number `game` of a match of the ledger, exactly as it was played.

    chances: ask the versions once more how likely each action was; those that cannot be loaded any more are not asked.
    Raises NotFound, and InvalidReference if the match has no such game.
    """
    ledger = Ledger(registry)
    record = ledger.match(match)
    if not 0 <= game < len(record.games):
        raise InvalidReference(f"match {match} has games 0 to {len(record.games) - 1}, not {game}")
    row = registry.league(record.league)
    agents = list(row.interface.agents)
    seats = zip(agents, sides_of(agents, seated(row.interface, record.games[game])), strict=True)
    cast = {agent: record.contestants[record.games[game].sides[side]] for agent, side in seats}
    players = _graphs(cast, registry, row.interface) if chances else {}
    return Show(
        title=f"{match} · game {game}",
        config=row.config,
        interface=row.interface,
        cast=cast,
        play=lambda environment: replay(environment, row.config, row.interface, record, game, players),
        opening=ledger.schedule(record.schedule).opening_plies,
        note=_forfeits(record, game),
    )


def _graphs(cast: Mapping[str, str], registry: Registry, interface: Interface) -> dict[str, Policy]:
    """agent → its policy, of those that are played by versions which are still there."""
    found: dict[str, Mapping[str, tuple[str, Policy]]] = {}
    for ref in set(cast.values()):
        if isinstance(parse_ref(ref), CheckpointRef):
            with suppress(LeagueError):
                found[ref] = contestant(ref, registry, interface)
    return {agent: found[ref][agent][1] for agent, ref in cast.items() if ref in found}


def _forfeits(match: Match, game: int) -> str | None:
    """`forfeited by duo@3 as player_1: illegal action`"""
    told = [
        f"forfeited by {match.contestants[forfeit.contestant]} as {forfeit.agent}: {forfeit.reason.replace('_', ' ')}"
        for forfeit in match.games[game].forfeits
    ]
    return "; ".join(told) or None


def _cast(refs: Sequence[str], interface: Interface, first: str | None) -> dict[str, str]:
    sides = list(interface.sides)
    if first is not None and first not in sides:
        raise InvalidReference(f"there is no side {first!r}; known: {', '.join(sides)}")
    if len(refs) > len(sides):
        raise InvalidReference(f"{len(refs)} were named for {len(sides)} side(s): {', '.join(sides)}")
    sides.sort(key=lambda side: side != first)
    player = {side: refs[min(place, len(refs) - 1)] for place, side in enumerate(sides)}
    return {agent: player[side] for side, agents in interface.sides.items() for agent in agents}
