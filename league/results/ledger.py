"""The append-only store of what was played. It takes what its schedules ask for, and each match once."""

from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime
from typing import Any, TypeVarTuple

from sqlalchemy import Select, Subquery, func, select, tuple_, union_all, update
from sqlalchemy.orm import Session

from league.errors import InvalidInput, NotFound, UnknownMatch
from league.registry import leagues, tables
from league.registry.database import insert
from league.registry.registry import Registry
from league.results.admission import admit
from league.results.documents import (
    dump_games,
    dump_numbers,
    dump_schedule,
    load_games,
    load_numbers,
    load_schedule,
)
from league.results.records import BlockResult, Entry, Match, Schedule

Columns = TypeVarTuple("Columns")
STRIDE = 1000
"""Matches that are read at a time by whoever goes through many."""


class Ledger:
    """Schedules and their matches, in the registry's database. Raises StorageError when that fails."""

    def __init__(self, registry: Registry) -> None:
        self._database = registry.database

    def open(self, schedule: Schedule) -> Schedule:
        """Store a schedule unless its id is there already; returns the stored one. Raises UnknownLeague."""
        row = {"id": schedule.id, "league": schedule.league, "kind": schedule.kind, "document": dump_schedule(schedule)}
        with self._database.write() as session:
            leagues.require(session, schedule.league)
            insert(session, tables.Schedule, [row | {"opened_at": datetime.now(UTC)}])
            return _schedule(session, schedule.id)

    def schedules(self, league: str) -> list[Schedule]:
        """All schedules of a league, in the order in which they were opened. Raises UnknownLeague."""
        with self._database.read() as session:
            return _schedules(session, league)

    def purged(self, league: str) -> set[str]:
        """The schedules of a league whose matches count for nothing."""
        table = tables.Schedule
        with self._database.read() as session:
            return set(session.scalars(select(table.id).where(table.league == league, table.purged_at.is_not(None))))

    def schedule(self, schedule: str) -> Schedule:
        """One schedule by its id. Raises NotFound."""
        with self._database.read() as session:
            return _schedule(session, schedule)

    def purge(self, schedules: Collection[str]) -> None:
        """Let the matches of these schedules count for nothing from now on. They stay, and can be replayed."""
        with self._database.write() as session:
            table = tables.Schedule
            session.execute(
                update(table)
                .where(table.id.in_(schedules), table.purged_at.is_(None))
                .values(purged_at=datetime.now(UTC))
            )

    def append(self, match: Match) -> bool:
        """Store a match; False if it is there already. Raises LedgerRefusal if it breaks its schedule."""
        return self.extend([match]) == 1

    def extend(self, matches: Sequence[Match]) -> int:
        """Store matches, all or none; returns how many were new. Raises LedgerRefusal if one does not fit."""
        with self._database.write() as session:
            schedules = {name: _schedule(session, name) for name in {match.schedule for match in matches}}
            for match in matches:
                admit(match, schedules[match.schedule])
            return insert(session, tables.Match, [row(match) for match in matches])

    def matches(self, *, league: str, schedule: str | None = None, after: int | None = None) -> list[Match]:
        """The matches of a league, or of one of its schedules, in schedule order.

        after: only those at later positions than this.
        """
        with self._database.read() as session:
            schedules = {known.id: known for known in _schedules(session, league, schedule)}
            query = _in_order(select(tables.Match.schedule, tables.Match.position, tables.Match.moves), league)
            if schedule is not None:
                query = query.where(tables.Match.schedule == schedule)
            if after is not None:
                query = query.where(tables.Match.position > after)
            found = session.execute(query)
            return [schedules[of].match(position, load_games(moves)) for of, position, moves in found]

    def walk(self, schedule: Schedule) -> Iterator[Match]:
        """The matches of a schedule in its order, a few of them in memory at a time."""
        last, table = -1, tables.Match
        query = select(table.position, table.moves).filter_by(schedule=schedule.id).order_by(table.position)
        while True:
            with self._database.read() as session:
                found = session.execute(query.where(table.position > last).limit(STRIDE)).all()
            yield from (schedule.match(position, load_games(moves)) for position, moves in found)
            if len(found) < STRIDE:
                return
            last = found[-1].position

    def match(self, match: str) -> Match:
        """One match by its id. Raises UnknownMatch."""
        return self.scheduled_match(match)[1]

    def scheduled_match(self, match: str) -> tuple[Schedule, Match]:
        """One match by its id, with its schedule. Raises UnknownMatch."""
        name, position = _place(match)
        with self._database.read() as session:
            moves = session.scalar(select(tables.Match.moves).filter_by(schedule=name, position=position))
            if moves is None:
                raise _no_match(match)
            schedule = _schedule(session, name)
            return schedule, schedule.match(position, load_games(moves))

    def page(
        self, league: str, *, contestants: tuple[str, str] | None = None, before: str | None = None, limit: int = 20
    ) -> list[Entry]:
        """The matches of a league as they were played, newest first, without their moves, purged ones included.

        contestants: only those between these two, in either order. before: those played before the match of this id.
        Raises UnknownLeague, or InvalidInput if `before` is no match of the league.
        """
        table = tables.Match
        ways = dict.fromkeys((contestants, contestants[::-1])) if contestants else ()
        with self._database.read() as session:
            leagues.require(session, league)
            query = select(*_LISTED).where(table.league == league)
            if before is not None:
                query = query.where(tuple_(*_PLAYED) < _when_played(session, league, before))
            query = query.order_by(*(column.desc() for column in _PLAYED)).limit(limit)
            # Each way round is read by itself, as it is then a range of an index.
            parts = [query.where(table.first == first, table.second == second) for first, second in ways] or [query]
            return _entries(session, union_all(*(select(part.subquery()) for part in parts)).subquery(), limit)

    def entry(self, match: str) -> Entry:
        """A match by its id, without its moves. Raises UnknownMatch."""
        schedule, position = _place(match)
        with self._database.read() as session:
            one = select(*_LISTED).filter_by(schedule=schedule, position=position)
            found = _entries(session, one.subquery(), limit=1)
        if not found:
            raise _no_match(match)
        return found[0]

    def positions(self, schedule: str) -> set[int]:
        """Which positions of a schedule were played."""
        with self._database.read() as session:
            return set(session.scalars(select(tables.Match.position).filter_by(schedule=schedule)))

    def counts(self, league: str) -> dict[str, int]:
        """schedule → how many of its matches were played, of all schedules of a league of which any were."""
        match = tables.Match
        query = select(match.schedule, func.count()).filter_by(league=league).group_by(match.schedule)
        with self._database.read() as session:
            return dict(session.execute(query).tuples().all())

    def results(self, league: str, environment_digest: str | None = None) -> list[BlockResult]:
        """The matches of a league without their moves, in schedule order; of one environment if given.

        Without those of purged schedules, and those in which the contestants were one team: they say nothing of who is
        stronger.
        """
        match = tables.Match
        columns = match.schedule, match.position, match.games, match.scores, match.returns
        with self._database.read() as session:
            schedules = {
                known.id: known
                for known in _schedules(session, league)
                if environment_digest in (None, known.environment_digest) and known.scoring != "team"
            }
            found = session.execute(_in_order(select(*columns), league).where(tables.Schedule.purged_at.is_(None)))
            return [
                BlockResult(
                    schedule=of,
                    position=position,
                    contestants=schedules[of].contestants_at(position),
                    games=games,
                    scores=load_numbers(scores),
                    returns=load_numbers(returns) or None,
                )
                for of, position, games, scores, returns in found
                if of in schedules
            ]


_LISTED = tuple(
    getattr(tables.Match, name)
    for name in ("schedule", "position", "first", "second", "games", "scores", "returns", "played_at")
)
_PLAYED = tables.Match.played_at, tables.Match.schedule, tables.Match.position
"""The order in which matches were played."""


def _schedules(session: Session, league: str, only: str | None = None) -> list[Schedule]:
    leagues.require(session, league)
    query = select(tables.Schedule.document).filter_by(league=league).order_by(tables.Schedule.sequence)
    if only is not None:
        query = query.filter_by(id=only)
    return [load_schedule(document) for document in session.scalars(query)]


def _schedule(session: Session, name: str) -> Schedule:
    document = session.scalar(select(tables.Schedule.document).filter_by(id=name))
    if document is None:
        raise NotFound(f"no schedule {name!r} was opened")
    return load_schedule(document)


def _place(match: str) -> tuple[str, int]:
    """Schedule and position of a match's id; a position that no match has if it is no id."""
    schedule, _, position = match.rpartition("/")
    return schedule, int(position) if position.isdecimal() and len(position) < 10 else -1


def _no_match(match: str) -> UnknownMatch:
    schedule, _, position = match.rpartition("/")
    return UnknownMatch(f"schedule {schedule} has no match {position!r}")


def _when_played(session: Session, league: str, match: str) -> tuple[Any, ...]:
    schedule, position = _place(match)
    found = session.execute(select(*_PLAYED).filter_by(league=league, schedule=schedule, position=position)).first()
    if found is None:
        raise InvalidInput(f"before: league {league} has no match {match!r}")
    return tuple(found)


def _entries(session: Session, found: Subquery, limit: int) -> list[Entry]:
    """What was found in the ledger's table, newest first, each with what its schedule says."""
    schedule, newest_first = tables.Schedule, (found.c[column.key].desc() for column in _PLAYED)
    query = select(*found.c, schedule.kind, schedule.purged_at).join(schedule, schedule.id == found.c.schedule)
    return [
        Entry(
            BlockResult(
                schedule=each.schedule,
                position=each.position,
                contestants=(each.first, each.second),
                games=each.games,
                scores=load_numbers(each.scores),
                returns=load_numbers(each.returns) or None,
            ),
            kind=each.kind,
            played_at=each.played_at,
            is_purged=each.purged_at is not None,
        )
        for each in session.execute(query.order_by(*newest_first).limit(limit))
    ]


def _in_order(query: Select[*Columns], league: str) -> Select[*Columns]:
    query = query.join(tables.Schedule, tables.Schedule.id == tables.Match.schedule)
    query = query.where(tables.Schedule.league == league)
    return query.order_by(tables.Schedule.sequence, tables.Match.position)


def row(match: Match) -> dict[str, Any]:
    """A match as the ledger keeps it."""
    result = match.result()
    first, second = match.contestants
    return {
        "schedule": match.schedule,
        "position": match.position,
        "league": match.league,
        "first": first,
        "second": second,
        "games": result.games,
        "scores": dump_numbers(result.scores),
        "returns": dump_numbers(result.returns or ()),
        "moves": dump_games(match.games),
        "played_at": datetime.now(UTC),
    }
