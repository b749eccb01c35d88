"""What replicas measure of themselves, as they wrote it last: whoever is asked for metrics answers for all of them."""

from datetime import UTC, datetime, timedelta
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from league.registry.database import upsert
from league.registry.tables import Report


def write(session: Session, replica: str, document: dict[str, Any]) -> None:
    """Replace what `replica` has said of itself."""
    upsert(session, Report, {"replica": replica}, {"document": document, "at": datetime.now(UTC)})


def fresh(session: Session, since: timedelta) -> dict[str, dict[str, Any]]:
    """replica → what it said, if that was in the last `since`."""
    found = session.scalars(select(Report).where(Report.at >= datetime.now(UTC) - since).order_by(Report.replica))
    return {report.replica: report.document for report in found}


def forget(session: Session, replica: str, before: timedelta) -> None:
    """Remove what a replica said, which stops, and what is older than `before`, whose replicas died without a word."""
    stale = Report.at < datetime.now(UTC) - before
    session.execute(delete(Report).where((Report.replica == replica) | stale))
