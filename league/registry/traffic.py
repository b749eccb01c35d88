"""Which part of a league's requests goes to a canary, and which is mirrored to a shadow: settings, each with its audit.

A setting is a row that never changes; the newest of a league is in force. A canary or shadow is named by a number, or
by an alias, whose movements it then follows.
"""

from datetime import UTC, datetime
from enum import Enum

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from league.errors import InvalidInput
from league.refs import CHAMPION, CheckpointRef, parse_version
from league.registry import leagues, rows, versions
from league.registry.rows import Portion
from league.registry.tables import TrafficEvent


class Unchanged(Enum):
    """`KEEP` as a portion: leave it as it is."""

    KEEP = "keep"


KEEP = Unchanged.KEEP


def put(
    session: Session,
    league: str,
    *,
    canary: Portion | Unchanged | None,
    shadow: Portion | Unchanged | None,
    actor: str,
    reason: str,
) -> rows.Traffic:
    """Set the canary and the shadow of a league; None ends one, KEEP leaves it.

    Returns the setting in force: what is set so already is left alone.
    Raises UnknownLeague, UnknownVersion, UnknownAlias or InvalidInput.
    """
    leagues.lock(session, league)
    now = current(session, league)
    wanted = tuple(
        before if portion is KEEP else portion for portion, before in ((canary, now.canary), (shadow, now.shadow))
    )
    for portion in wanted:
        if isinstance(portion, Portion):
            _check(session, league, portion)
    if now.id is not None and wanted == (now.canary, now.shadow):
        return now
    event = TrafficEvent(league=league, actor=actor, reason=reason, at=datetime.now(UTC))
    (event.canary, event.canary_share), (event.shadow, event.shadow_share) = (
        (str(portion.version), portion.share) if isinstance(portion, Portion) else (None, None) for portion in wanted
    )
    session.add(event)
    session.flush()
    return row(event)


def current(session: Session, league: str) -> rows.Traffic:
    """The setting in force; one without an id where nothing was ever set. Raises UnknownLeague."""
    leagues.require(session, league)
    query = select(TrafficEvent).filter_by(league=league).order_by(TrafficEvent.id.desc()).limit(1)
    event = session.scalar(query)
    return rows.Traffic(league=league) if event is None else row(event)


def every(session: Session) -> dict[str, rows.Traffic]:
    """league → its setting in force, of the leagues that have one."""
    newest = select(func.max(TrafficEvent.id)).group_by(TrafficEvent.league)
    found = session.scalars(select(TrafficEvent).where(TrafficEvent.id.in_(newest)))
    return {event.league: row(event) for event in found}


def history(session: Session, league: str) -> list[rows.Traffic]:
    """All settings of a league, newest first. Raises UnknownLeague."""
    leagues.require(session, league)
    query = select(TrafficEvent).filter_by(league=league).order_by(TrafficEvent.id.desc())
    return [row(event) for event in session.scalars(query)]


def row(event: TrafficEvent) -> rows.Traffic:
    """A setting as the registry answers it."""
    return rows.Traffic(
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


def _check(session: Session, league: str, portion: Portion) -> None:
    if portion.version == CHAMPION:
        raise InvalidInput(f"a canary or shadow is held against the {CHAMPION}: it must be another version")
    if not 0 <= portion.share <= 1:
        raise InvalidInput(f"share {portion.share:g} must be from 0 to 1")
    versions.resolve(session, CheckpointRef(league, portion.version))
