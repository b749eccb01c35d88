"""Former champions of a league, from the history of the alias."""

from __future__ import annotations

from collections.abc import Sequence

from league.registry.registry import Registry
from league.registry.storage.rows import AliasEvent, LeagueRow


def earlier_champions(registry: Registry, league: LeagueRow, most: int) -> list[str]:
    """The last `most` former champions, newest first.

    Versions that were rolled back or trained in another environment are left out.
    """
    events = registry.aliases.history(league.slug)
    refused = rolled_back(events)
    reigned = dict.fromkeys(event.version for event in events)
    champion = events[0].version if events else None
    refs: list[str] = []
    for number in reigned:
        if number == champion or number in refused or len(refs) == most:
            continue
        if registry.versions.get(league.slug, number).manifest.environment_digest == league.environment_digest:
            refs.append(f"{league.slug}@{number}")
    return refs


def rolled_back(events: Sequence[AliasEvent]) -> set[int]:
    """Return the former champions that a person replaced with their predecessors. events: history of the alias."""
    return {event.previous for event in events if event.kind == "rollback" and event.previous is not None}
