"""Aliases move by compare-and-set, and each movement leaves an event. Events form a stack for rollback:

    set 1            set 2            set 3           rollback          rollback        set 4
    version 1   ←    version 2   ←    version 3       version 2         version 1       version 4
                                                      (beneath: 1)      (beneath: –)    (beneath: 1)

`beneath` is the event that a rollback returns to. A set lies on the event before it; a rollback lies where
the event that it returned to did, so that rolling back twice goes two versions back.
"""

from datetime import UTC, datetime
from enum import Enum
from typing import Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.errors import AliasMoved, NothingToRollBack
from league.refs import check_alias
from league.registry import leagues, rows, verdicts, versions
from league.registry.tables import Alias, AliasEvent


class AnyVersion(Enum):
    """`ANY` as the expected version: set the alias wherever it points."""

    ANY = "any"


ANY = AnyVersion.ANY


def current(session: Session, league: str) -> dict[str, int]:
    """alias → version. Raises UnknownLeague."""
    leagues.require(session, league)
    found = session.scalars(select(Alias).filter_by(league=league).order_by(Alias.name))
    return {alias.name: alias.version for alias in found}


def every(session: Session) -> dict[tuple[str, str], int]:
    """(league, alias) → version, of all leagues, by one query."""
    found = session.execute(select(Alias.league, Alias.name, Alias.version))
    return {(league, name): version for league, name, version in found}


def move(
    session: Session,
    league: str,
    alias: str,
    version: int,
    *,
    expected: int | AnyVersion | None,
    actor: str,
    reason: str,
    verdict: str | None,
) -> rows.AliasEvent:
    """Point `alias` at `version` if it points at `expected` (None: if there is no such alias).

    Returns the event in force: an alias that is there already is left alone, for a rollback
    must lead elsewhere.
    Raises UnknownLeague, UnknownVersion, AliasMoved if it points elsewhere, and Conflict if `verdict` is closed.
    """
    check_alias(alias)
    leagues.lock(session, league)
    if verdict is not None:
        verdicts.require_open(session, verdict)
    versions.require(session, league, version)
    last = _in_force(session, league, alias)
    found = last.version if last else None
    if expected is not ANY and found != expected:
        now = f"is at {league}@{found} now" if found else "is not set"
        wanted = f"{league}@{expected}" if expected else "not set"
        raise AliasMoved(f"alias {alias} of league {league} {now}, expected {wanted}: nothing was changed")
    if last and last.version == version:
        return row(last)
    event = AliasEvent(
        kind="set",
        version=version,
        beneath=last.id if last else None,
        actor=actor,
        reason=reason,
        verdict=verdict,
    )
    return _record(session, league, alias, last, event)


def roll_back(session: Session, league: str, alias: str, *, actor: str, reason: str) -> rows.AliasEvent:
    """Return `alias` to where it was before its version came. Raises UnknownLeague or NothingToRollBack."""
    leagues.lock(session, league)
    last = _in_force(session, league, alias)
    beneath = session.get(AliasEvent, last.beneath) if last and last.beneath else None
    if beneath is None:
        was = f"has had no version before {league}@{last.version}" if last else "was never set"
        raise NothingToRollBack(f"alias {alias} of league {league} {was}")
    event = AliasEvent(
        kind="rollback",
        version=beneath.version,
        beneath=beneath.beneath,
        actor=actor,
        reason=reason,
        verdict=None,
    )
    return _record(session, league, alias, last, event)


def history(
    session: Session, league: str, alias: str, at: datetime | None, before: int | None, limit: int | None
) -> list[rows.AliasEvent]:
    """The events of an alias, newest first; with `at`, only the one in force then. Raises UnknownLeague.

    before: those older than the event of this id. limit: so many at most.
    """
    leagues.require(session, league)
    query = select(AliasEvent).filter_by(league=league, alias=alias).order_by(AliasEvent.id.desc()).limit(limit)
    if before is not None:
        query = query.where(AliasEvent.id < before)
    if at is not None:
        query = query.where(AliasEvent.at <= at).limit(1)
    return [row(event) for event in session.scalars(query)]


def _in_force(session: Session, league: str, alias: str) -> AliasEvent | None:
    query = select(AliasEvent).join(Alias, Alias.event == AliasEvent.id)
    return session.scalar(query.where(Alias.league == league, Alias.name == alias))


def _record(session: Session, league: str, alias: str, last: AliasEvent | None, event: AliasEvent) -> rows.AliasEvent:
    event.league, event.alias = league, alias
    event.previous = last.version if last else None
    # Clocks of machines differ; events are ordered by their ids, which their times must not contradict.
    event.at = max(datetime.now(UTC), last.at) if last else datetime.now(UTC)
    session.add(event)
    session.flush()
    session.merge(Alias(league=league, name=alias, version=event.version, event=event.id))
    return row(event)


def row(event: AliasEvent) -> rows.AliasEvent:
    """An event as the registry answers it."""
    kind: Literal["set", "rollback"] = "rollback" if event.kind == "rollback" else "set"
    return rows.AliasEvent(
        id=event.id,
        league=event.league,
        alias=event.alias,
        kind=kind,
        version=event.version,
        previous=event.previous,
        actor=event.actor,
        reason=event.reason,
        verdict=event.verdict,
        at=event.at,
    )
