"""Canary and shadow settings of leagues, and the results of shadows.

A canary answers a share of the requests for the champion; a shadow gets mirrored requests. Each setting is an immutable
row with its actor and reason, and the newest row of a league is in force. A canary or shadow is a version number, or an
alias that it follows. Each replica writes its shadow counters since it started, so that writing them again is
idempotent; the counters are kept after the replica stops.
"""

from collections.abc import Collection
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from enum import Enum

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from league.errors import InvalidInput
from league.histograms import Histogram
from league.refs import CHAMPION, CheckpointRef, parse_version
from league.registry import leagues, versions
from league.registry.storage import change_counter
from league.registry.storage.database import Repository, as_method, reading, upsert, writing
from league.registry.storage.idempotency import IdempotentCall, apply_once
from league.registry.storage.rows import Portion, ShadowCounts, Traffic
from league.registry.storage.tables import TrafficEventTable

SHADOW_COUNTS_KEPT = timedelta(days=90)
COUNTERS = ("requests", "observations", "agreed", "failed", "dropped", "skipped")


class Unchanged(Enum):
    """`KEEP` as a portion: leave it unchanged."""

    KEEP = "keep"


KEEP = Unchanged.KEEP


def current_setting(session: Session, league: str) -> Traffic:
    """Return the setting in force; without an id if none was ever set. Raises UnknownLeague."""
    leagues.require(session, league)
    return setting_at(session, league) or Traffic(league=league)


class TrafficRepository(Repository):
    """Sets and reads canaries and shadows."""

    @writing
    def set(
        self,
        session: Session,
        league: str,
        *,
        canary: Portion | Unchanged | None = KEEP,
        shadow: Portion | Unchanged | None = KEEP,
        actor: str,
        reason: str,
        call: IdempotentCall | None = None,
    ) -> Traffic:
        """Set the canary and the shadow of a league; None ends one, KEEP leaves it unchanged.

        Returns the setting in force, which is the old one if nothing differs. A repeated `call` changes nothing and
        returns its setting. Raises UnknownLeague, UnknownVersion, UnknownAlias, NotPromotable, InvalidInput or
        KeyReused.
        """
        leagues.lock(session, league)

        def change() -> Traffic:
            setting = current_setting(session, league)
            new_portions = (
                setting.canary if isinstance(canary, Unchanged) else canary,
                setting.shadow if isinstance(shadow, Unchanged) else shadow,
            )
            for portion in (canary, shadow):
                if isinstance(portion, Portion):
                    _check(session, league, portion)
            if setting.id is not None and new_portions == (setting.canary, setting.shadow):
                return setting
            change_counter.count(session, "traffic")
            return _record(session, league, *new_portions, actor=actor, reason=reason)

        def load(event: int) -> Traffic:
            return _row(session.get_one(TrafficEventTable, event))

        return apply_once(session, call, "traffic", change=change, load=load)

    current = as_method(current_setting)

    @reading
    def all(self, session: Session) -> dict[str, Traffic]:
        """Return league → its setting in force, of the leagues that have one, by one cheap query."""
        newest = select(func.max(TrafficEventTable.id)).group_by(TrafficEventTable.league)
        events = session.scalars(select(TrafficEventTable).where(TrafficEventTable.id.in_(newest)))
        return {event.league: _row(event) for event in events}

    @reading
    def shadow_counts(self, session: Session, league: str) -> list[ShadowCounts]:
        """Return the shadow counters of a league, summed over replicas, by candidate and champion."""
        table = ShadowCounts
        query = select(table).filter_by(league=league).order_by(table.candidate, table.champion)
        counts_by_pair: dict[tuple[int, int], list[ShadowCounts]] = {}
        for count in session.scalars(query):
            counts_by_pair.setdefault((count.candidate, count.champion), []).append(count)
        return [_sum(league, *pair, counts) for pair, counts in counts_by_pair.items()]


def write_shadow_counts(session: Session, replica: str, counts: Collection[ShadowCounts]) -> None:
    """Replace the shadow counters of `replica`, and delete old ones of all replicas."""
    if not counts:
        return
    written_at = datetime.now(UTC)
    for count in counts:
        values = asdict(count) | {"replica": replica, "at": written_at}
        key = {name: values.pop(name) for name in ("replica", "league", "candidate", "champion")}
        upsert(session, ShadowCounts, key, values)
    session.execute(delete(ShadowCounts).where(ShadowCounts.at < written_at - SHADOW_COUNTS_KEPT))


def end(session: Session, league: str, portions: Collection[str], *, actor: str, reason: str) -> None:
    """End the canary, the shadow, or both, in a transaction that has counted it."""
    setting = current_setting(session, league)
    kept = (None if name in portions else getattr(setting, name) for name in ("canary", "shadow"))
    _record(session, league, *kept, actor=actor, reason=reason)


def _record(
    session: Session, league: str, canary: Portion | None, shadow: Portion | None, *, actor: str, reason: str
) -> Traffic:
    event = TrafficEventTable(league=league, actor=actor, reason=reason, at=datetime.now(UTC))
    (event.canary, event.canary_share), (event.shadow, event.shadow_share) = (
        (None, None) if portion is None else (str(portion.version), portion.share) for portion in (canary, shadow)
    )
    session.add(event)
    session.flush()
    return _row(event)


def setting_at(session: Session, league: str, newest: int | None = None) -> Traffic | None:
    """Return the setting that was in force when the setting with the id `newest`, of any league, was the newest; by
    default the one in force."""
    query = select(TrafficEventTable).filter_by(league=league).order_by(TrafficEventTable.id.desc()).limit(1)
    event = session.scalar(query if newest is None else query.where(TrafficEventTable.id <= newest))
    return None if event is None else _row(event)


def _check(session: Session, league: str, portion: Portion) -> None:
    if portion.version == CHAMPION:
        raise InvalidInput(f"a canary or shadow is compared with the {CHAMPION}: it must be another version")
    if not 0 <= portion.share <= 1:
        raise InvalidInput(f"share {portion.share:g} must be from 0 to 1")
    version = versions.resolve(session, CheckpointRef(league, portion.version))
    versions.require_promotable(session, league, version.number)


def _row(event: TrafficEventTable) -> Traffic:
    return Traffic(
        league=event.league,
        id=event.id,
        canary=_portion(event.canary, event.canary_share),
        shadow=_portion(event.shadow, event.shadow_share),
        actor=event.actor,
        reason=event.reason,
        at=event.at,
    )


def _portion(version: str | None, share: float | None) -> Portion | None:
    return None if version is None or share is None else Portion(parse_version(version), share)


def _sum(league: str, candidate: int, champion: int, counts: list[ShadowCounts]) -> ShadowCounts:
    latency = Histogram()
    for count in counts:
        latency.merge(count.latency, count.ns)
    sums = {name: sum(getattr(count, name) for count in counts) for name in COUNTERS}
    return ShadowCounts(league, candidate, champion, **sums, latency=latency.counts, ns=latency.ns)
