"""What the gate has found out about a version, in one sentence.

For leaderboards whose first is not the champion, and before a promotion by hand.
"""

from __future__ import annotations

from collections.abc import Sequence

from evaluation.documents import Standing
from league.refs import CHAMPION, CheckpointRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.rows import VerdictRow, VersionRow
from league.registry.verdicts import VOID
from league.results.ledger import Ledger


def why_not_champion(registry: Registry, league: str, leaderboard: Sequence[Standing]) -> str | None:
    """Explain why the first of a leaderboard is not the champion; None if it is, or if nothing is rated.

    A script, bot or remote model cannot become champion: the explanation is about the best version.
    """
    versions = [
        standing
        for standing in leaderboard
        if standing.rating is not None
        and isinstance(parsed := parse_ref(standing.ref), CheckpointRef)
        and parsed.league == league
    ]
    champion = registry.aliases.current(league).get(CHAMPION)
    if not versions or versions[0].ref == f"{league}@{champion}":
        return None
    best = versions[0]
    holder = "there is no champion" if champion is None else f"the champion is {league}@{champion}"
    finding = gate_record(registry, registry.versions.resolve(CheckpointRef.parse(best.ref)))
    return f"{best.ref} is the best version by rating, but {holder}: {finding}{_overlap(best, leaderboard, champion)}."


def _overlap(best: Standing, leaderboard: Sequence[Standing], champion: int | None) -> str:
    """Whether the difference of the two ratings may be chance."""
    holder = next(
        (standing for standing in leaderboard if standing.ref == f"{best.ref.partition('@')[0]}@{champion}"), None
    )
    if champion is None:
        return ""
    if holder is None or holder.rating is None:
        return "; the champion is not rated under the current conditions"
    if best.interval and holder.interval and best.interval[0] <= holder.interval[1]:
        return "; their 95 % intervals overlap"
    return ""


def gate_record(registry: Registry, version: VersionRow) -> str:
    """Return what decided about a version, without a subject: `was rejected in verdict 0f3a62d1: …`."""
    number = version.number
    if version.retired_at is not None:
        return "it is retired"
    events = registry.aliases.history(version.league)
    for event in events:  # newest first
        if event.previous == number and event.version != number:
            how = "rolled back" if event.kind == "rollback" else f"replaced by {version.league}@{event.version}"
            return f"it was {how} on {event.at:%Y-%m-%d} by {event.actor} ({event.reason})"
    verdict = newest_verdict(registry, version)
    if verdict is None:
        return f"it has not been tested: `league nightly {version.league}` tests it"
    return _finding(registry, verdict)


def newest_verdict(registry: Registry, version: VersionRow) -> VerdictRow | None:
    """Return the last verdict on a version that is not void, else the last one; None without any."""
    rows = [row for row in registry.verdicts.all(version.league) if row.candidate == version.number]
    return next((row for row in reversed(rows) if row.outcome != VOID), rows[-1] if rows else None)


def _finding(registry: Registry, verdict: VerdictRow) -> str:
    evidence, name = verdict.evidence or {}, f"verdict {verdict.short_id}"
    note = evidence.get("note") or f"it did not pass the test against {verdict.champion}"
    conditions = Ledger(registry).schedule(verdict.schedule).conditions
    earlier = ""
    if conditions != registry.leagues.get(verdict.league).conditions and verdict.outcome is not None:
        earlier = (
            f"; the league's game or selection of actions has changed since, and after `league void {verdict.short_id}`"
            " the next nightly run tests it again"
        )
    match verdict.outcome:
        case None:
            return f"{name} on it is open, and `league nightly {verdict.league}` continues it"
        case "reject":
            return f"it was rejected in {name}: {note}{earlier}"
        case "inconclusive":
            return f"{name} on it was inconclusive: {note}{earlier}"
        case "promote" if evidence.get("promoted"):
            return f"it was promoted in {name}{earlier}"
    return f"{name} on it did not count: {note}; the next nightly run tests it again"


def doubts(registry: Registry, version: VersionRow) -> str | None:
    """Return why a version should not become champion: the gate has rejected it, or it has not played.

    A mixture has played if all its members have. Games count if they were played under the current conditions.
    """
    verdict = newest_verdict(registry, version)
    if verdict is not None and verdict.outcome == "reject":
        scored = (verdict.evidence or {}).get("reason") or _finding(registry, verdict)
        return f"the gate has rejected {version.ref} in verdict {verdict.short_id}: {scored.rstrip('.')}"
    members = (version.number,) if version.mixture is None else version.mixture.versions
    ledger, conditions = Ledger(registry), registry.leagues.get(version.league).conditions
    idle = [
        ref for ref in (f"{version.league}@{number}" for number in members) if not ledger.has_played(ref, conditions)
    ]
    if not idle:
        return None
    have = "has" if len(idle) == 1 else "have"
    hint = f"`league nightly {version.league}` tests new versions"
    return f"{', '.join(idle)} {have} played no game under the current conditions ({hint})"
