"""Aliases, set by compare-and-set. Every change is recorded as an event.

Events form a stack for rollback:

    set 1            set 2            set 3           rollback          rollback        set 4
    version 1   ←    version 2   ←    version 3       version 2         version 1       version 4
                                                      (beneath: 1)      (beneath: –)    (beneath: 1)

`beneath` is the event that a rollback returns to. A set lies on the previous event. A rollback takes over the
`beneath` of the event that it returns to, so two rollbacks go two versions back.
"""

from datetime import UTC, datetime
from enum import Enum
from functools import partial
from typing import Literal

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.errors import AliasMoved, NothingToRollBack
from league.refs import CHAMPION, check_alias
from league.registry import leagues, verdicts, versions
from league.registry.storage import change_counter
from league.registry.storage.database import Repository, as_method, reading, writing
from league.registry.storage.idempotency import IdempotentCall, apply_once
from league.registry.storage.rows import AliasEvent, AliasTarget
from league.registry.storage.tables import AliasTable


class AnyVersion(Enum):
    """`ANY` as the expected version: set the alias unconditionally."""

    ANY = "any"


ANY = AnyVersion.ANY
_ALL = select(*(AliasTable.__table__.c[name] for name in ("league", "name", "version", "event")))


def current(session: Session, league: str) -> dict[str, int]:
    """Return alias → version. Raises UnknownLeague."""
    leagues.require(session, league)
    aliases = session.scalars(select(AliasTable).filter_by(league=league).order_by(AliasTable.name))
    return {alias.name: alias.version for alias in aliases}


class AliasRepository(Repository):
    """Sets, rolls back and reads aliases."""

    current = as_method(current)

    def all(self) -> dict[tuple[str, str], AliasTarget]:
        """Return (league, alias) → its target, of all leagues, by one cheap query."""
        rows = self._database.rows(_ALL)
        return {(league, name): AliasTarget(version, event) for league, name, version, event in rows}

    @writing
    def set(
        self,
        session: Session,
        league: str,
        alias: str,
        version: int,
        *,
        expected: int | AnyVersion | None,
        actor: str,
        reason: str,
        verdict: str | None = None,
        call: IdempotentCall | None = None,
    ) -> AliasEvent:
        """Point `alias` at `version` if it points at `expected` (None: if it is not set; ANY: always).

        Returns the event in force. A repeated `call` changes nothing and returns its event. An alias already
        at `version` keeps its event, because a rollback must lead to another version.
        Raises UnknownLeague, UnknownVersion, NotPromotable for an exploiter as champion, KeyReused, Conflict if
        `verdict` is closed, or AliasMoved if the alias points elsewhere.
        """
        check_alias(alias)
        leagues.lock(session, league)

        def change() -> AliasEvent:
            if verdict is not None:
                verdicts.require_open(session, verdict)
            last = _check(session, league, alias, version, expected)
            if last and last.version == version:
                return last
            beneath = last.id if last else None
            return _record(
                session, league, alias, last, "set", version, beneath, actor=actor, reason=reason, verdict=verdict
            )

        return apply_once(session, call, "event", change=change, load=partial(session.get_one, AliasEvent))

    @reading
    def check(
        self, session: Session, league: str, alias: str, version: int, *, expected: int | AnyVersion | None
    ) -> None:
        """Raise what `set` would raise now, and change nothing: for callers that ask for confirmation first."""
        _check(session, league, alias, version, expected)

    @writing
    def rollback(
        self,
        session: Session,
        league: str,
        *,
        expected: int | AnyVersion = ANY,
        actor: str,
        reason: str,
        call: IdempotentCall | None = None,
    ) -> AliasEvent:
        """Return the champion to the version before it, if it is `expected` now (ANY: always).

        A repeated `call` changes nothing and returns its event. Raises UnknownLeague, AliasMoved, NothingToRollBack or
        KeyReused.
        """
        leagues.lock(session, league)

        def change() -> AliasEvent:
            last = _in_force(session, league, CHAMPION)
            _require(last, league, CHAMPION, expected)
            beneath = session.get(AliasEvent, last.beneath) if last and last.beneath else None
            if beneath is None:
                reason_against = (
                    f"has no version before {league}@{last.version} to return to"
                    if last
                    else "is not set: promote a version"
                )
                raise NothingToRollBack(f"alias {CHAMPION} of league {league} {reason_against}")
            version, next_beneath = beneath.version, beneath.beneath
            return _record(
                session, league, CHAMPION, last, "rollback", version, next_beneath, actor=actor, reason=reason
            )

        return apply_once(session, call, "event", change=change, load=partial(session.get_one, AliasEvent))

    @reading
    def history(
        self,
        session: Session,
        league: str,
        alias: str = CHAMPION,
        at: datetime | None = None,
        *,
        before: int | None = None,
        limit: int | None = None,
    ) -> list[AliasEvent]:
        """Return the events of an alias, newest first. Raises UnknownLeague.

        at: return only the event in force at this time. before: return only events older than the event with this id.
        """
        table = AliasEvent
        query = select(table).filter_by(league=league, alias=alias).order_by(table.id.desc()).limit(limit)
        if before is not None:
            query = query.where(table.id < before)
        if at is not None:
            query = query.where(table.at <= at).limit(1)
        return leagues.rows(session, league, query)


def _check(
    session: Session, league: str, alias: str, version: int, expected: int | AnyVersion | None
) -> AliasEvent | None:
    """Return the event in force if the alias may be moved from `expected` to `version`, else raise."""
    require = versions.require_promotable if alias == CHAMPION else versions.require_files
    require(session, league, version)
    last = _in_force(session, league, alias)
    _require(last, league, alias, expected)
    return last


def _in_force(session: Session, league: str, alias: str) -> AliasEvent | None:
    query = select(AliasEvent).join(AliasTable, AliasTable.event == AliasEvent.id)
    return session.scalar(query.where(AliasTable.league == league, AliasTable.name == alias))


def _require(last: AliasEvent | None, league: str, alias: str, expected: int | AnyVersion | None) -> None:
    """Raise AliasMoved unless the alias points to `expected`."""
    version = last.version if last else None
    if expected is not ANY and version != expected:
        actual_state = f"is at {league}@{version} now" if version else "is not set"
        expected_state = f"{league}@{expected}" if expected else "not set"
        raise AliasMoved(
            f"alias {alias} of league {league} {actual_state}, expected {expected_state}: nothing was changed"
        )


def _record(
    session: Session,
    league: str,
    alias: str,
    last: AliasEvent | None,
    kind: Literal["set", "rollback"],
    version: int,
    beneath: int | None,
    *,
    actor: str,
    reason: str,
    verdict: str | None = None,
) -> AliasEvent:
    change_counter.count(session, "aliases")
    event = AliasEvent(
        league=league,
        alias=alias,
        kind=kind,
        version=version,
        previous=last.version if last else None,
        beneath=beneath,
        actor=actor,
        reason=reason,
        verdict=verdict,
        # Clocks of machines differ. Events are ordered by id, and their times must not contradict that order.
        at=max(datetime.now(UTC), last.at) if last else datetime.now(UTC),
    )
    session.add(event)
    session.flush()
    session.merge(AliasTable(league=league, name=alias, version=version, event=event.id))
    return event
