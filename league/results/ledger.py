"""The append-only store of matches. It accepts each scheduled match once."""

from collections.abc import Collection, Iterator, Sequence
from datetime import UTC, datetime
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVarTuple

from sqlalchemy import Select, Subquery, func, select, tuple_, union_all, update
from sqlalchemy.orm import Session

from league.conditions import Conditions
from league.errors import InvalidInput, NotFound, OutOfSpace, UnknownMatch
from league.files import free_space
from league.refs import CheckpointRef
from league.registry import leagues
from league.registry.registry import Registry
from league.registry.storage import tables
from league.registry.storage.database import insert
from league.results.records import (
    BlockResult,
    LedgerEntry,
    Match,
    Schedule,
    dump_games,
    dump_numbers,
    dump_schedule,
    load_games,
    load_numbers,
    load_schedule,
)
from league.results.scoring import admit

Columns = TypeVarTuple("Columns")
RESERVE = 256 * 2**20
"""Bytes of the disk with an SQLite database that games must leave free, for promotions and acknowledgements."""
MOST_BYTES = 4 * 2**30
"""Size of the recorded games of a schedule."""
STRIDE = 1000
"""Matches per query when iterating over a schedule."""


class Ledger:
    """Schedules and their matches in the registry's database. Raises StorageError if the database fails."""

    def __init__(self, registry: Registry) -> None:
        self._database = registry.database
        self._sizes: dict[str, int] = {}
        """Schedule → size of its recorded games in bytes, if this object has added some."""

    def open(self, schedule: Schedule) -> Schedule:
        """Store a schedule unless its id exists; returns the stored one. Raises UnknownLeague."""
        row = {"id": schedule.id, "league": schedule.league, "kind": schedule.kind, "document": dump_schedule(schedule)}
        with self._database.write() as session:
            leagues.require(session, schedule.league)
            insert(session, tables.ScheduleTable, [row | {"opened_at": datetime.now(UTC)}])
            return _schedule(session, schedule.id)

    def schedules(self, league: str) -> list[Schedule]:
        """Return all schedules of a league in the order in which they were opened. Raises UnknownLeague."""
        with self._database.read() as session:
            return _schedules(session, league)

    def purged(self, league: str) -> set[str]:
        """Return the ids of the purged schedules of a league, whose matches are not counted."""
        table = tables.ScheduleTable
        with self._database.read() as session:
            return set(session.scalars(select(table.id).where(table.league == league, table.purged_at.is_not(None))))

    def schedule(self, schedule: str) -> Schedule:
        """Return one schedule. Raises NotFound."""
        with self._database.read() as session:
            return _schedule(session, schedule)

    def purge(self, schedules: Collection[str]) -> None:
        """Exclude the matches of these schedules from all results. They are kept and can be replayed."""
        with self._database.write() as session:
            table = tables.ScheduleTable
            session.execute(
                update(table)
                .where(table.id.in_(schedules), table.purged_at.is_(None))
                .values(purged_at=datetime.now(UTC))
            )

    def append(self, match: Match) -> bool:
        """Store a match; False if it exists. Raises LedgerConflict if it contradicts its schedule."""
        return self.extend([match]) == 1

    def extend(self, matches: Sequence[Match]) -> int:
        """Store matches, all or none; returns the number of new ones.

        Raises LedgerConflict if one contradicts its schedule, or OutOfSpace.
        """
        file = self._database.engine.url.database
        if self._database.is_sqlite and file and (free := free_space(Path(file))) < RESERVE:
            raise OutOfSpace(
                f"{free // 2**20} MB are free on the disk of {file}: games are recorded only if they leave "
                f"{RESERVE // 2**20} MB; what was played so far is kept"
            )
        with self._database.write() as session:
            schedules = {name: _schedule(session, name) for name in {match.schedule for match in matches}}
            for schedule in schedules.values():
                group = [match for match in matches if match.schedule == schedule.id]
                for match, seed in zip(group, schedule.seeds_at([match.position for match in group]), strict=True):
                    admit(match, schedule, seed)
            stored_at = datetime.now(UTC)
            rows = [row(match, stored_at) for match in matches]
            for name in schedules:
                self._add_size(
                    session, name, sum(len(record["moves"]) for record in rows if record["schedule"] == name)
                )
            return insert(session, tables.MatchTable, rows)

    def _add_size(self, session: Session, schedule: str, size: int) -> None:
        """Count the size of new games of a schedule. Raises OutOfSpace."""
        if schedule not in self._sizes:
            moves = tables.MatchTable.moves
            recorded = select(func.coalesce(func.sum(func.length(moves)), 0)).filter_by(schedule=schedule)
            self._sizes[schedule] = int(session.scalar(recorded) or 0)
        if self._sizes[schedule] + size > MOST_BYTES:
            raise OutOfSpace(
                f"the recorded games of schedule {schedule} would exceed {MOST_BYTES // 2**20:,} MB: "
                "what was played so far is kept"
            )
        self._sizes[schedule] += size

    def matches(self, *, league: str, schedule: str | None = None) -> list[Match]:
        """Return the matches of a league, or of one of its schedules, in schedule order."""
        with self._database.read() as session:
            schedules = {
                league_schedule.id: league_schedule for league_schedule in _schedules(session, league, schedule)
            }
            query = _in_order(
                select(tables.MatchTable.schedule, tables.MatchTable.position, tables.MatchTable.moves), league
            )
            if schedule is not None:
                query = query.where(tables.MatchTable.schedule == schedule)
            groups = groupby(session.execute(query), key=attrgetter("schedule"))
            return [match for name, rows in groups for match in _matches(schedules[name], list(rows))]

    def walk(self, schedule: Schedule) -> Iterator[Match]:
        """Iterate over the matches of a schedule in order, with at most STRIDE of them in memory."""
        last, table = -1, tables.MatchTable
        query = select(table.position, table.moves).filter_by(schedule=schedule.id).order_by(table.position)
        while True:
            with self._database.read() as session:
                rows = session.execute(query.where(table.position > last).limit(STRIDE)).all()
            yield from _matches(schedule, rows)
            if len(rows) < STRIDE:
                return
            last = rows[-1].position

    def match(self, match: str) -> Match:
        """Return one match. Raises UnknownMatch."""
        return self.scheduled_match(match)[1]

    def scheduled_match(self, match: str) -> tuple[Schedule, Match]:
        """Return one match with its schedule. Raises UnknownMatch."""
        name, position = _place(match)
        with self._database.read() as session:
            moves = session.scalar(select(tables.MatchTable.moves).filter_by(schedule=name, position=position))
            if moves is None:
                raise _no_match(match)
            schedule = _schedule(session, name)
            return schedule, schedule.match(position, load_games(moves))

    def page(
        self, league: str, *, contestants: tuple[str, str] | None = None, before: str | None = None, limit: int = 20
    ) -> list[LedgerEntry]:
        """Return at most `limit` matches of a league without moves, newest first, purged ones included.

        contestants: return only matches between these two, in either order. before: return only matches played before
        this one. Raises UnknownLeague, or InvalidInput if `before` is not a match of the league.
        """
        table = tables.MatchTable
        orders = dict.fromkeys((contestants, contestants[::-1])) if contestants else ()
        with self._database.read() as session:
            leagues.require(session, league)
            query = select(*_LISTED).where(table.league == league)
            if before is not None:
                schedule, position = _place(before)
                when = select(*_PLAYED).filter_by(league=league, schedule=schedule, position=position)
                if (sort_key := session.execute(when).first()) is None:
                    raise InvalidInput(f"before: league {league} has no match {before!r}")
                query = query.where(tuple_(*_PLAYED) < tuple(sort_key))
            query = query.order_by(*(column.desc() for column in _PLAYED)).limit(limit)
            # Each order of the contestants is a query of its own, because it is then a range of an index.
            parts = [query.where(table.first == first, table.second == second) for first, second in orders] or [query]
            return _entries(session, union_all(*(select(part.subquery()) for part in parts)).subquery(), limit)

    def entry(self, match: str) -> LedgerEntry:
        """Return one match without moves. Raises UnknownMatch."""
        schedule, position = _place(match)
        with self._database.read() as session:
            one = select(*_LISTED).filter_by(schedule=schedule, position=position)
            entries = _entries(session, one.subquery(), limit=1)
        if not entries:
            raise _no_match(match)
        return entries[0]

    def positions(self, schedule: str) -> set[int]:
        """Return the positions of a schedule that were played."""
        with self._database.read() as session:
            return set(session.scalars(select(tables.MatchTable.position).filter_by(schedule=schedule)))

    def counts(self, league: str) -> dict[str, int]:
        """Return schedule → number of played matches, of the schedules of a league that have any."""
        match = tables.MatchTable
        query = select(match.schedule, func.count()).filter_by(league=league).group_by(match.schedule)
        with self._database.read() as session:
            return dict(session.execute(query).tuples().all())

    def has_played(self, ref: str, conditions: Conditions) -> bool:
        """Return whether a version has a match under these conditions that counts."""
        match = tables.MatchTable
        league = CheckpointRef.parse(ref).league
        query = select(match.schedule).filter_by(league=league).distinct()
        with self._database.read() as session:
            counted = {
                league_schedule.id
                for league_schedule in _schedules(session, league)
                if league_schedule.conditions == conditions and ref in league_schedule.contestants
            }
            return any(
                schedule in counted
                for side in (match.first, match.second)
                for schedule in session.scalars(query.where(side == ref))
            )

    def results(
        self, league: str, conditions: Conditions | None = None, between: tuple[str, str] | None = None
    ) -> list[BlockResult]:
        """Return the matches of a league without moves, in schedule order.

        conditions, between: only those played under these conditions, and between these two contestants. Excludes
        purged schedules, and cross-play in one team, which does not show who is stronger.
        """
        match = tables.MatchTable
        columns = match.schedule, match.position, match.games, match.scores, match.returns
        with self._database.read() as session:
            schedules = {
                schedule.id: schedule
                for schedule in _schedules(session, league)
                if conditions in (None, schedule.conditions) and schedule.scoring != "team"
            }
            query = _in_order(select(*columns), league).where(tables.ScheduleTable.purged_at.is_(None))
            if between is not None:
                query = query.where(tuple_(match.first, match.second).in_([between, between[::-1]]))
            match_rows = session.execute(query)
            return [
                _result(match_row, schedules[match_row.schedule].contestants_at(match_row.position))
                for match_row in match_rows
                if match_row.schedule in schedules
            ]


_LISTED = tuple(
    getattr(tables.MatchTable, name)
    for name in ("schedule", "position", "first", "second", "games", "scores", "returns", "played_at")
)
_PLAYED = tables.MatchTable.played_at, tables.MatchTable.schedule, tables.MatchTable.position
"""Sort key for the order in which matches were played."""


def _schedules(session: Session, league: str, only: str | None = None) -> list[Schedule]:
    leagues.require(session, league)
    query = select(tables.ScheduleTable.document).filter_by(league=league).order_by(tables.ScheduleTable.sequence)
    if only is not None:
        query = query.filter_by(id=only)
    return [load_schedule(document) for document in session.scalars(query)]


def _schedule(session: Session, name: str) -> Schedule:
    document = session.scalar(select(tables.ScheduleTable.document).filter_by(id=name))
    if document is None:
        raise NotFound(f"there is no schedule {name!r}")
    return load_schedule(document)


def _matches(schedule: Schedule, rows: Sequence[Any]) -> list[Match]:
    """Return the matches of some rows of one schedule, which have its positions and moves."""
    seeds = schedule.seeds_at([row.position for row in rows])
    return [schedule.match(row.position, load_games(row.moves), seed) for row, seed in zip(rows, seeds, strict=True)]


def _place(match: str) -> tuple[str, int]:
    """Schedule and position of a match id; position -1, which no match has, if the id is invalid."""
    schedule, _, position = match.rpartition("/")
    return schedule, int(position) if position.isdecimal() and len(position) < 10 else -1


def _no_match(match: str) -> UnknownMatch:
    schedule, _, position = match.rpartition("/")
    return UnknownMatch(f"schedule {schedule} has no match {position!r}")


def _entries(session: Session, found: Subquery, limit: int) -> list[LedgerEntry]:
    """Join rows of the ledger with their schedules, newest first."""
    schedule, newest_first = tables.ScheduleTable, (found.c[column.key].desc() for column in _PLAYED)
    query = select(*found.c, schedule.kind, schedule.purged_at).join(schedule, schedule.id == found.c.schedule)
    rows = session.execute(query.order_by(*newest_first).limit(limit)).all()
    schedules = {name: _schedule(session, name) for name in {match_row.schedule for match_row in rows}}
    return [
        LedgerEntry(
            _result(match_row, (match_row.first, match_row.second)),
            kind=match_row.kind,
            played_at=match_row.played_at,
            is_purged=match_row.purged_at is not None,
            conditions=schedules[match_row.schedule].conditions,
        )
        for match_row in rows
    ]


def _result(row: Any, contestants: tuple[str, ...]) -> BlockResult:
    returns = load_numbers(row.returns) or None
    return BlockResult(row.schedule, row.position, contestants, row.games, load_numbers(row.scores), returns)


def _in_order(query: Select[*Columns], league: str) -> Select[*Columns]:
    query = query.join(tables.ScheduleTable, tables.ScheduleTable.id == tables.MatchTable.schedule)
    query = query.where(tables.ScheduleTable.league == league)
    return query.order_by(tables.ScheduleTable.sequence, tables.MatchTable.position)


def row(match: Match, played_at: datetime) -> dict[str, Any]:
    """Return the row of a match."""
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
        "played_at": played_at,
    }
