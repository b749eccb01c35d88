"""The append-only store of matches. It accepts each scheduled match once."""

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any

from sqlalchemy import Select, Subquery, delete, func, or_, select, tuple_, union_all, update
from sqlalchemy.orm import Session

from league.conditions import Conditions
from league.errors import InvalidInput, NotFound, OutOfSpace, UnknownMatch
from league.files import free_space
from league.refs import CheckpointRef
from league.registry import leagues
from league.registry.registry import Registry
from league.registry.storage import tables
from league.registry.storage.database import Repository, as_method, insert, reading, upsert_all, writing
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
from league.results.schedule_sums import ScheduleSums
from league.results.scoring import admit
from league.results.sums import Pair, PairSums, pair_of, total

RESERVE = 256 * 2**20
"""Bytes of the disk with an SQLite database that games must leave free, for promotions and acknowledgements."""
MOST_BYTES = 4 * 2**30
"""Size of the recorded games of a schedule."""
STRIDE = 1000
"""Matches per query when iterating over a schedule."""


def _schedules(session: Session, league: str, only: str | None = None) -> list[Schedule]:
    """Return all schedules of a league in the order in which they were opened, or `only` one. Raises UnknownLeague."""
    leagues.require(session, league)
    query = select(tables.ScheduleTable.document).filter_by(league=league).order_by(tables.ScheduleTable.sequence)
    if only is not None:
        query = query.filter_by(id=only)
    return [load_schedule(document) for document in session.scalars(query)]


def _schedule(session: Session, schedule: str) -> Schedule:
    """Return one schedule. Raises NotFound."""
    document = session.scalar(select(tables.ScheduleTable.document).filter_by(id=schedule))
    if document is None:
        raise NotFound(f"there is no schedule {schedule!r}")
    return load_schedule(document)


class Ledger(Repository):
    """Schedules and their matches in the registry's database. Raises StorageError if the database fails."""

    def __init__(self, registry: Registry) -> None:
        super().__init__(registry.database)

    @writing
    def open(self, session: Session, schedule: Schedule) -> Schedule:
        """Store a schedule unless its id exists; returns the stored one. Raises UnknownLeague."""
        row = {"id": schedule.id, "league": schedule.league, "kind": schedule.kind, "document": dump_schedule(schedule)}
        leagues.require(session, schedule.league)
        insert(session, tables.ScheduleTable, [row | {"opened_at": datetime.now(UTC)}])
        stored = _schedule(session, schedule.id)
        insert(session, tables.ScheduleTotalTable, [ScheduleSums(stored).total()])
        return stored

    schedules = as_method(_schedules)
    schedule = as_method(_schedule)

    @reading
    def purged(self, session: Session, league: str) -> set[str]:
        """Return the ids of the purged schedules of a league, whose matches are not counted."""
        table = tables.ScheduleTable
        return set(session.scalars(select(table.id).where(table.league == league, table.purged_at.is_not(None))))

    @writing
    def purge(self, session: Session, schedules: Collection[str]) -> None:
        """Exclude the matches of these schedules from all results. They are kept and can be replayed."""
        table = tables.ScheduleTable
        of_these = update(table).where(table.id.in_(schedules), table.purged_at.is_(None))
        session.execute(of_these.values(purged_at=datetime.now(UTC)))

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
        batches, stored_at = [], datetime.now(UTC)
        # In one order, so that transactions do not wait for each other.
        for schedule in map(self.schedule, sorted({match.schedule for match in matches})):
            group = [match for match in matches if match.schedule == schedule.id]
            for match, seed in zip(group, schedule.seeds_at([match.position for match in group]), strict=True):
                admit(match, schedule, seed)
            batches.append((schedule, [(match, row(match, stored_at)) for match in group]))
        with self._database.write() as session:
            return sum(_extend(session, schedule, group) for schedule, group in batches)

    def recount(self, schedule: Schedule, mend: bool = True) -> list[str]:
        """Compute the sums of a schedule from its matches; returns which stored ones differ.

        mend: replace these. Matches can be added at the same time.
        """
        while True:
            sums = ScheduleSums(schedule)
            for batch in self._batches(schedule):
                sums.add(batch)
            with self._database.write() as session:
                _lock_total(session, schedule)
                match = tables.MatchTable
                query = select(func.count(), func.coalesce(func.sum(func.length(match.moves)), 0))
                number, sums.size = session.execute(query.where(match.schedule == schedule.id)).one()
                if number == sums.matches:
                    return _differences(session, schedule, sums, mend)

    def matches(self, *, league: str, schedule: str | None = None) -> list[Match]:
        """Return the matches of a league, or of one of its schedules, in schedule order."""
        schedules = self.schedules(league, schedule)
        return [match for league_schedule in schedules for match in self.walk(league_schedule)]

    def walk(self, schedule: Schedule) -> Iterator[Match]:
        """Iterate over the matches of a schedule in order, with at most STRIDE of them in memory."""
        return chain.from_iterable(self._batches(schedule))

    def _batches(self, schedule: Schedule) -> Iterator[list[Match]]:
        last, table = -1, tables.MatchTable
        query = select(table.position, table.moves).filter_by(schedule=schedule.id).order_by(table.position)
        while True:
            with self._database.read() as session:
                rows = session.execute(query.where(table.position > last).limit(STRIDE)).all()
            yield _matches(schedule, rows)
            if len(rows) < STRIDE:
                return
            last = rows[-1].position

    def match(self, match: str) -> Match:
        """Return one match. Raises UnknownMatch."""
        return self.scheduled_match(match)[1]

    @reading
    def scheduled_match(self, session: Session, match: str) -> tuple[Schedule, Match]:
        """Return one match with its schedule. Raises UnknownMatch."""
        name, position = _place(match)
        moves = session.scalar(select(tables.MatchTable.moves).filter_by(schedule=name, position=position))
        if moves is None:
            raise _no_match(match)
        schedule = _schedule(session, name)
        return schedule, schedule.match(position, load_games(moves))

    @reading
    def page(
        self,
        session: Session,
        league: str,
        *,
        contestants: tuple[str, str] | None = None,
        before: str | None = None,
        limit: int = 20,
    ) -> list[LedgerEntry]:
        """Return at most `limit` matches of a league without moves, newest first, purged ones included.

        contestants: return only matches between these two, in either order. before: return only matches played before
        this one. Raises UnknownLeague, or InvalidInput if `before` is not a match of the league.
        """
        table = tables.MatchTable
        orders = dict.fromkeys((contestants, contestants[::-1])) if contestants else ()
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

    @reading
    def entry(self, session: Session, match: str) -> LedgerEntry:
        """Return one match without moves. Raises UnknownMatch."""
        schedule, position = _place(match)
        one = select(*_LISTED).filter_by(schedule=schedule, position=position)
        entries = _entries(session, one.subquery(), limit=1)
        if not entries:
            raise _no_match(match)
        return entries[0]

    @reading
    def positions(self, session: Session, schedule: str) -> set[int]:
        """Return the positions of a schedule that were played."""
        return set(session.scalars(select(tables.MatchTable.position).filter_by(schedule=schedule)))

    @reading
    def counts(self, session: Session, league: str) -> dict[str, int]:
        """Return schedule → number of played matches, of the schedules of a league that have any."""
        total = tables.ScheduleTotalTable
        query = select(total.schedule, total.matches).where(total.league == league, total.matches > 0)
        return dict(session.execute(query).tuples().all())

    @reading
    def has_played(self, session: Session, ref: str, conditions: Conditions) -> bool:
        """Return whether a version has a match under these conditions, also if it is not counted."""
        pair = tables.PairSumTable
        league = CheckpointRef.parse(ref).league
        query = select(pair.schedule).where(pair.league == league, or_(pair.first == ref, pair.second == ref))
        return any(_schedule(session, schedule).conditions == conditions for schedule in session.scalars(query).all())

    def counted(self, league: str, conditions: Conditions) -> list[Schedule]:
        """Return the schedules of a league that were played under these conditions, in the order of their opening.

        Excludes purged schedules, and cross-play in one team, which does not show who is stronger.
        """
        purged = self.purged(league)
        return [
            schedule
            for schedule in self.schedules(league)
            if schedule.conditions == conditions and schedule.scoring != "team" and schedule.id not in purged
        ]

    def sums(
        self, league: str, schedules: Iterable[Schedule], between: tuple[str, str] | None = None
    ) -> dict[Pair, PairSums]:
        """Return the sums over the matches of some schedules of a league, which must not be changed.

        between: only those of these two contestants.
        """
        pair = tables.PairSumTable
        query = select(pair.schedule, pair.first, pair.second, pair.sums).filter_by(league=league)
        if between is not None:
            first, second = pair_of(between)
            query = query.filter_by(first=first, second=second)
        return {
            pair: total(tuple([text for _, text in parts])) for pair, parts in self._texts(query, schedules).items()
        }

    def examples(self, league: str, schedules: Iterable[Schedule]) -> dict[Pair, list[tuple[str, str]]]:
        """Return examples of the games of each pair: the schedule, and what `load_examples` reads."""
        pair = tables.PairSumTable
        query = select(pair.schedule, pair.first, pair.second, pair.examples).filter_by(league=league)
        return self._texts(query, schedules)

    @reading
    def _texts(
        self, session: Session, query: Select[str, str, str, str], schedules: Iterable[Schedule]
    ) -> dict[Pair, list[tuple[str, str]]]:
        """Pair → schedule and text, of these schedules. query: schedules, contestants and texts."""
        names, texts = {schedule.id for schedule in schedules}, defaultdict[Pair, list[tuple[str, str]]](list)
        for name, first, second, text in session.execute(query).tuples():
            if name in names:
                texts[first, second].append((name, text))
        return dict(texts)

    def digests(self, league: str) -> Iterator[tuple[str, int, bytes]]:
        """Iterate over the digests of a league's games by schedule: first position, and the digests from there."""
        row = tables.GameDigestTable
        query = select(row.schedule, row.stripe, row.digests).filter_by(league=league).order_by(row.schedule)
        with self._database.read() as session:
            for schedule, stripe, digests in session.execute(query).tuples():
                yield schedule, stripe * tables.STRIPE, digests


_LISTED = tuple(
    getattr(tables.MatchTable, name)
    for name in ("schedule", "position", "first", "second", "games", "scores", "returns", "played_at")
)
_PLAYED = tables.MatchTable.played_at, tables.MatchTable.schedule, tables.MatchTable.position
"""Sort key for the order in which matches were played."""


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


def _extend(session: Session, schedule: Schedule, matches: Sequence[tuple[Match, Mapping[str, Any]]]) -> int:
    """Add matches of one schedule, with their rows and sums; returns the number of new ones. Raises OutOfSpace."""
    total, table = _lock_total(session, schedule), tables.MatchTable
    first: dict[int, tuple[Match, Mapping[str, Any]]] = {}
    for match, record in matches:
        first.setdefault(match.position, (match, record))
    query = select(table.position).where(table.schedule == schedule.id)
    recorded = set(session.scalars(query.where(table.position.between(min(first), max(first)))))
    new = [added for position, added in first.items() if position not in recorded]
    if not new:
        return 0
    total.matches += len(new)
    total.size += sum(len(record["moves"]) for _, record in new)
    if total.size > MOST_BYTES:
        raise OutOfSpace(
            f"the recorded games of schedule {schedule.id} would exceed {MOST_BYTES // 2**20:,} MB: "
            "what was played so far is kept"
        )
    insert(session, table, [record for _, record in new])
    _add_to_sums(session, schedule, [match for match, _ in new])
    return len(new)


def _lock_total(session: Session, schedule: Schedule) -> tables.ScheduleTotalTable:
    """Until the transaction ends, no other one adds matches to the schedule. Raises NotFound."""
    query = select(tables.ScheduleTotalTable).filter_by(schedule=schedule.id)
    if (total := session.scalars(query.with_for_update()).one_or_none()) is None:
        raise NotFound(f"there is no schedule {schedule.id!r}")
    return total


def _add_to_sums(session: Session, schedule: Schedule, matches: Sequence[Match]) -> None:
    sums, pair, digest = ScheduleSums(schedule), tables.PairSumTable, tables.GameDigestTable
    pairs = sorted({pair_of(match.contestants) for match in matches})
    stripes = {match.position // tables.STRIPE for match in matches}
    query = select(pair.first, pair.second, pair.sums, pair.examples).filter_by(schedule=schedule.id)
    for start in range(0, len(pairs), PAIRS):
        some = tuple_(pair.first, pair.second).in_(pairs[start : start + PAIRS])
        sums.load(session.execute(query.where(some)), ())
    stored = select(digest.stripe, digest.digests).filter_by(schedule=schedule.id)
    sums.load((), session.execute(stored.where(digest.stripe.in_(stripes))))
    sums.add(matches)
    upsert_all(session, pair, ("schedule", "first", "second"), sums.pair_rows())
    upsert_all(session, digest, ("schedule", "stripe"), sums.digest_rows())


def _differences(session: Session, schedule: Schedule, sums: ScheduleSums, mend: bool) -> list[str]:
    """Which stored sums of a schedule differ from `sums`, and with `mend` are replaced."""
    differences = []
    for table, key, rows in (
        (tables.ScheduleTotalTable, ("schedule",), [sums.total()]),
        (tables.PairSumTable, ("first", "second"), sums.pair_rows()),
        (tables.GameDigestTable, ("stripe",), sums.digest_rows()),
    ):
        stored = session.execute(select(*table.__table__.columns).filter_by(schedule=schedule.id)).mappings()
        before, after = (
            {tuple(record[name] for name in key): dict(record) for record in part} for part in (stored, rows)
        )
        differing = sorted(place for place in before.keys() | after.keys() if before.get(place) != after.get(place))
        if differing:
            differences += [f"{table.__tablename__} of {' '.join(map(str, place))}" for place in differing]
            if mend:
                session.execute(delete(table).filter_by(schedule=schedule.id))
                insert(session, table, rows)
    return differences


PAIRS = 500
"""Pairs of contestants in a query."""


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
