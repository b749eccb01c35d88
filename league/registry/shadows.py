"""What shadows have shown: how often a candidate acted as the champion did on mirrored requests, and how long it took.

Each replica writes what it has counted since it started, so that writing it again changes nothing. What a replica has
seen outlives it.
"""

from collections.abc import Iterable
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from league.histograms import Histogram
from league.registry.database import upsert
from league.registry.rows import Shadowing
from league.registry.tables import ShadowCount

KEPT = timedelta(days=90)
COUNTS = ("requests", "observations", "agreed", "failed", "dropped", "skipped")


def write(session: Session, replica: str, counted: Iterable[Shadowing]) -> None:
    """Replace what `replica` has counted of these."""
    now = datetime.now(UTC)
    for shadowing in counted:
        values = asdict(shadowing)
        key = {"replica": replica} | {name: values.pop(name) for name in ("league", "candidate", "champion")}
        upsert(session, ShadowCount, key, values | {"latency": list(shadowing.latency), "at": now})
    session.execute(delete(ShadowCount).where(ShadowCount.at < now - KEPT))


def merged(session: Session, league: str) -> list[Shadowing]:
    """What all replicas have counted of a league: one for each candidate and the champion that it was held against."""
    query = select(ShadowCount).filter_by(league=league).order_by(ShadowCount.candidate, ShadowCount.champion)
    found: dict[tuple[int, int], list[ShadowCount]] = {}
    for count in session.scalars(query):
        found.setdefault((count.candidate, count.champion), []).append(count)
    return [_sum(league, *pair, counts) for pair, counts in found.items()]


def _sum(league: str, candidate: int, champion: int, counts: list[ShadowCount]) -> Shadowing:
    latency = Histogram()
    for count in counts:
        latency.merge(count.latency, count.ns)
    sums = {name: sum(getattr(count, name) for count in counts) for name in COUNTS}
    return Shadowing(league, candidate, champion, **sums, latency=tuple(latency.counts), ns=latency.ns)
