"""To whom a challenger must not be inferior: those that the gate names, and champions of the past.

A challenger that has learnt to beat the champion may have forgotten how to beat those before it: where rock beats
scissors and scissors beat paper, paper that beats rock is no progress.
"""

from __future__ import annotations

from league.config import AnchorConfig
from league.errors import UnknownAlias
from league.policies.pinning import check_eligible, pinned
from league.refs import of_league
from league.registry.registry import Registry
from league.registry.rows import LeagueRow


def anchors_of(registry: Registry, league: LeagueRow, candidate: int, champion: str) -> list[AnchorConfig]:
    """The anchors of a verdict that opens now, pinned, in the order in which they are tested: named ones first.

    Neither the candidate nor the champion is its own anchor. An alias that points nowhere yet is left out.
    Raises UnknownVersion, UnknownPolicy, EnvironmentMismatch and InvalidReference for anchors that cannot play.
    """
    gate = league.config.gate
    wanted = [*gate.anchors, *(AnchorConfig(ref=ref) for ref in earlier_champions(registry, league))]
    found: dict[str, AnchorConfig] = {}
    for anchor in wanted:
        try:
            ref = pinned(of_league(anchor.ref, league.slug), league.slug, registry)
        except UnknownAlias:
            continue
        check_eligible(ref, registry, league.config)
        if ref not in (f"{league.slug}@{candidate}", champion):
            found.setdefault(ref, anchor.model_copy(update={"ref": ref}))
    return list(found.values())


def earlier_champions(registry: Registry, league: LeagueRow) -> list[str]:
    """The last `gate.earlier_champions` before the present one, newest first.

    Not those that were rolled back, for whatever was wrong with them, nor those of another environment.
    """
    events = registry.history(league.slug)
    rolled_back = {event.previous for event in events if event.kind == "rollback"}
    reigned = dict.fromkeys(event.version for event in events)
    now = events[0].version if events else None
    refs: list[str] = []
    for number in reigned:
        if number == now or number in rolled_back or len(refs) == league.config.gate.earlier_champions:
            continue
        if registry.version(league.slug, number).manifest.environment_digest == league.environment_digest:
            refs.append(f"{league.slug}@{number}")
    return refs
