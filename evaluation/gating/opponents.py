"""Opponents of a candidate besides the champion: anchors, and exploiters of recent champions.

A candidate that beats the champion may lose to earlier champions. In a cycle such as rock, paper, scissors, beating
the current champion is not progress. And it may have given up what made the champion hard to exploit.
"""

from __future__ import annotations

from league.config.gate import AnchorConfig
from league.errors import UnknownAlias
from league.policies.loading import check_eligible, pinned
from league.refs import ScriptRef, of_league, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow, VersionRow


def resolve_anchors(registry: Registry, league: LeagueRow, candidate: int, champion: str) -> list[AnchorConfig]:
    """Resolve the anchors of a new verdict to fixed references, in the order of testing: named anchors first.

    The candidate and the champion are left out, as are aliases that do not exist yet.
    Raises UnknownVersion, UnknownPolicy, EnvironmentMismatch and InvalidReference for anchors that cannot play.
    """
    gate = league.config.gate
    former = earlier_champions(registry, league, gate.earlier_champions)
    anchors = [*gate.anchors, *(AnchorConfig(ref=ref) for ref in former)]
    pinned_anchors: dict[str, AnchorConfig] = {}
    for anchor in anchors:
        try:
            ref = pinned(of_league(anchor.ref, league.slug), league.slug, registry)
        except UnknownAlias:
            continue
        check_eligible(ref, registry, league.config)
        if ref not in (f"{league.slug}@{candidate}", champion):
            pinned_anchors.setdefault(ref, anchor.model_copy(update={"ref": ref}))
    return list(pinned_anchors.values())


def earlier_champions(registry: Registry, league: LeagueRow, most: int) -> list[str]:
    """The last `most` former champions, newest first.

    Versions that were rolled back or trained in another environment are left out.
    """
    events, refused = registry.aliases.history(league.slug), rolled_back(registry, league.slug)
    reigned = dict.fromkeys(event.version for event in events)
    champion = events[0].version if events else None
    refs: list[str] = []
    for number in reigned:
        if number == champion or number in refused or len(refs) == most:
            continue
        if registry.versions.get(league.slug, number).manifest.environment_digest == league.environment_digest:
            refs.append(f"{league.slug}@{number}")
    return refs


def rolled_back(registry: Registry, league: str) -> set[int]:
    """Return the former champions that a person replaced with their predecessors."""
    events = registry.aliases.history(league)
    return {event.previous for event in events if event.kind == "rollback" and event.previous is not None}


def recent_exploiters(registry: Registry, league: LeagueRow, champion: str) -> list[VersionRow]:
    """Return the newest exploiter of each of the last `gate.exploited_champions` champions, the current one's first.

    Champions without an exploiter, retired exploiters and those trained in another environment are left out.
    champion: the opponent of the verdict; a script has no exploiters.
    """
    number = league.config.gate.exploited_champions
    if isinstance(parse_ref(champion), ScriptRef) or not number:
        return []
    targets = [champion, *earlier_champions(registry, league, number - 1)]
    newest = {
        exploiter.exploits: exploiter
        for exploiter in registry.versions.exploiters(league.slug, targets)
        if exploiter.manifest.environment_digest == league.environment_digest
    }
    return [newest[target] for target in targets if target in newest]
