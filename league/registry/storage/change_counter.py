"""Counts changes of what replicas follow, so that they poll one row instead of aliases, traffic settings, API keys and
leagues.

A transaction that changes one of these counts it before it writes, and holds the lock of the row until it commits.
Hence changes of all leagues are committed one after the other, in the order of their event ids: a replica that has
read an event has read all earlier ones. PostgreSQL notifies the connections that listen on CHANNEL.
"""

from typing import Literal

from sqlalchemy import select, text
from sqlalchemy.orm import Session

from league.registry.storage.database import Database, increment
from league.registry.storage.listener import CHANNEL
from league.registry.storage.rows import ChangeCounts
from league.registry.storage.tables import ChangeCounterTable

ROW = 1
"""Id of the only row."""

_COUNTS = select(*(ChangeCounterTable.__table__.c[name] for name in ChangeCounts._fields)).filter_by(id=ROW)

Subject = Literal["aliases", "traffic", "keys", "leagues"]


def count(session: Session, subject: Subject) -> None:
    """Count a change that this transaction is about to make."""
    increment(session, ChangeCounterTable, {"id": ROW}, subject)
    if session.get_bind().dialect.name == "postgresql":
        session.execute(text(f"NOTIFY {CHANNEL}"))


def counts(database: Database) -> ChangeCounts:
    """Return the number of changes. Read it before what it counts."""
    rows = database.rows(_COUNTS)
    return ChangeCounts(*rows[0]) if rows else ChangeCounts(0, 0, 0, 0)
