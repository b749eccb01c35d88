"""What serving replicas say that they serve."""

from collections.abc import Mapping
from datetime import UTC, datetime, timedelta

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from league.registry import leagues, rows
from league.registry.database import upsert
from league.registry.tables import Acknowledgement

KEPT = timedelta(days=1)
"""Replicas that died without a word are forgotten after this."""


def write(
    session: Session,
    replica: str,
    league: str,
    version: int | None,
    sha256: str | None,
    fault: str | None,
    aliases: Mapping[str, int],
    traffic: int | None,
) -> None:
    """Replace what `replica` said of `league`. Raises UnknownLeague."""
    leagues.require(session, league)
    now = datetime.now(UTC)
    values = {"version": version, "sha256": sha256, "fault": fault, "aliases": dict(aliases), "traffic": traffic}
    upsert(session, Acknowledgement, {"replica": replica, "league": league}, values | {"seen_at": now})
    session.execute(delete(Acknowledgement).where(Acknowledgement.seen_at < now - KEPT))


def fresh(session: Session, league: str, since: timedelta) -> list[rows.Acknowledgement]:
    """What was said of `league` in the last `since`, by replica. Raises UnknownLeague."""
    leagues.require(session, league)
    query = select(Acknowledgement).filter_by(league=league).order_by(Acknowledgement.replica)
    found = session.scalars(query.where(Acknowledgement.seen_at >= datetime.now(UTC) - since))
    return [
        rows.Acknowledgement(
            row.replica, row.league, row.version, row.sha256, row.fault, row.aliases, row.seen_at, row.traffic
        )
        for row in found
    ]


def replicas(session: Session, since: timedelta) -> list[str]:
    """Who said anything, of whatever league, in the last `since`."""
    query = select(Acknowledgement.replica).where(Acknowledgement.seen_at >= datetime.now(UTC) - since)
    return sorted(session.scalars(query.distinct()))


def forget(session: Session, replica: str) -> None:
    """Remove all that a replica said: it stops."""
    session.execute(delete(Acknowledgement).filter_by(replica=replica))
