"""Tables that only the registry and the ledger read. Those whose rows they return are in `rows.py`.

Each change of a table needs a migration in `migrations/versions/`.
"""

from datetime import UTC, datetime
from typing import Any, ClassVar

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    Dialect,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    LargeBinary,
    MetaData,
    String,
    Text,
    TypeDecorator,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from league.registry.storage.manifest import MAIN

PUBLISHING, READY, ABANDONED = "publishing", "ready", "abandoned"
"""States of a version. Only `ready` versions are visible to others than their publisher."""


class Utc(TypeDecorator[datetime]):
    """A timestamp with time zone. SQLite has none, so it is stored there as naive UTC."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value} has no time zone")
        value = value.astimezone(UTC)
        return value.replace(tzinfo=None) if dialect.name == "sqlite" else value

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:  # noqa: ARG002
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class JsonCollection(TypeDecorator[Any]):
    """A tuple or frozenset of strings or numbers, stored as a sorted JSON list. kind: its type."""

    impl = JSON
    cache_ok = True

    def __init__(self, kind: type[tuple[Any, ...]] | type[frozenset[Any]]) -> None:
        super().__init__(none_as_null=True)
        self.kind = kind

    def process_bind_param(self, value: Any, dialect: Dialect) -> list[Any] | None:  # noqa: ARG002
        return None if value is None else sorted(value)

    def process_result_value(self, value: Any, dialect: Dialect) -> Any:  # noqa: ARG002
        return None if value is None else self.kind(value)


class Base(DeclarativeBase):
    """Base of the ORM classes. Names every constraint, so that a migration can drop it on any database."""

    type_annotation_map: ClassVar[dict[Any, Any]] = {
        datetime: Utc,
        float: Double,
        frozenset[str]: JsonCollection(frozenset),
        tuple[int, ...]: JsonCollection(tuple),
        **dict.fromkeys(
            (dict[str, Any], dict[str, float], dict[str, int], dict[str, str], list[int]), JSON(none_as_null=True)
        ),
    }
    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class VersionTable(Base):
    """A checkpoint version: reserved (`publishing`), complete (`ready`), or to be removed (`abandoned`).

    Role and `exploits` are those of the manifest.
    """

    __tablename__ = "versions"
    __table_args__ = (
        # Of rows whose state is `ready`. The migration says so: here it would import both dialects, which takes 0.1 s.
        Index("uq_versions_ready_source", "league", "source", unique=True),
        ForeignKeyConstraint(["league", "parent"], ["versions.league", "versions.number"]),
    )

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    state: Mapped[str] = mapped_column(String(16))
    source: Mapped[str] = mapped_column(Text)
    parent: Mapped[int | None]
    role: Mapped[str] = mapped_column(String(16), default=MAIN)
    exploits: Mapped[str | None] = mapped_column(Text)
    publisher: Mapped[str] = mapped_column(Text)
    """The process that writes it, see `league.registry.processes.this_process`."""
    reserved_at: Mapped[datetime]
    manifest: Mapped[str | None] = mapped_column(Text)
    """manifest.json, byte for byte; null until ready."""
    sha256: Mapped[str | None] = mapped_column(String(64))
    """Digest of manifest.json, which contains the digests of all other files."""
    retired_at: Mapped[datetime | None]
    """From then on the version has no files."""


class VersionNoteTable(Base):
    """A note on a version. Rows are immutable; the newest is in force, and an empty one removes the note."""

    __tablename__ = "version_notes"
    __table_args__ = (
        ForeignKeyConstraint(["league", "version"], ["versions.league", "versions.number"]),
        Index("ix_version_notes_league_version_id", "league", "version", "id"),
        Index("ix_version_notes_league_id", "league", "id"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(String(255))
    version: Mapped[int]
    text: Mapped[str] = mapped_column(Text)
    actor: Mapped[str] = mapped_column(Text)
    at: Mapped[datetime]


class AliasTable(Base):
    """The version that an alias points to, and the event that set it."""

    __tablename__ = "aliases"
    __table_args__ = (ForeignKeyConstraint(["league", "version"], ["versions.league", "versions.number"]),)

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), primary_key=True)
    version: Mapped[int]
    event: Mapped[int] = mapped_column(ForeignKey("alias_events.id"))


class ChangeCounterTable(Base):
    """One row: how often what replicas follow has changed, see change_counter.py."""

    __tablename__ = "change_counter"

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    aliases: Mapped[int] = mapped_column(BigInteger, server_default="0")
    traffic: Mapped[int] = mapped_column(BigInteger, server_default="0")
    keys: Mapped[int] = mapped_column(BigInteger, server_default="0")
    leagues: Mapped[int] = mapped_column(BigInteger, server_default="0")


class AcknowledgementTable(Base):
    """What a replica serves of a league, see ServedState, while it differs from what the replica has read."""

    __tablename__ = "acknowledgements"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    version: Mapped[int | None]
    sha256: Mapped[str | None] = mapped_column(String(64))
    fault: Mapped[str | None] = mapped_column(Text)
    aliases: Mapped[dict[str, int]]
    traffic: Mapped[int | None]
    event: Mapped[int | None]
    seen_at: Mapped[datetime] = mapped_column(index=True)


class ReplicaTable(Base):
    """A replica, see RegisteredReplica, and what it has read, see ReadPosition; null until it has read anything."""

    __tablename__ = "replicas"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    process: Mapped[dict[str, str]]
    changes: Mapped[int | None] = mapped_column(BigInteger)
    event: Mapped[int | None]
    traffic: Mapped[int | None]
    seen_at: Mapped[datetime] = mapped_column(index=True)


class TrafficEventTable(Base):
    """A setting of canary and shadow with actor and reason. Rows are immutable; the newest is in force."""

    __tablename__ = "traffic_events"
    __table_args__ = (Index("ix_traffic_events_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    canary: Mapped[str | None] = mapped_column(String(255))
    """A number or an alias."""
    canary_share: Mapped[float | None]
    shadow: Mapped[str | None] = mapped_column(String(255))
    shadow_share: Mapped[float | None]
    actor: Mapped[str] = mapped_column(Text)
    reason: Mapped[str] = mapped_column(Text)
    at: Mapped[datetime]


class ReplicaReportTable(Base):
    """Metrics of a replica, written by serve_app/observability/metrics.py."""

    __tablename__ = "reports"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    document: Mapped[dict[str, Any]]
    at: Mapped[datetime] = mapped_column(index=True)


class IdempotentCallTable(Base):
    """A call with an idempotency key and its result: an alias event, a traffic event or an evaluation."""

    __tablename__ = "idempotent_calls"

    owner: Mapped[str] = mapped_column(ForeignKey("api_keys.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    digest: Mapped[str] = mapped_column(String(64))
    """Digest of the request."""
    event: Mapped[int | None] = mapped_column(ForeignKey("alias_events.id"))
    traffic: Mapped[int | None] = mapped_column(ForeignKey("traffic_events.id"))
    evaluation: Mapped[int | None] = mapped_column(ForeignKey("evaluations.id"))
    at: Mapped[datetime] = mapped_column(index=True)


class ScheduleTable(Base):
    """A schedule of matches. `sequence` is the order in which schedules were opened."""

    __tablename__ = "schedules"

    sequence: Mapped[int] = mapped_column(primary_key=True)
    id: Mapped[str] = mapped_column(String(255), unique=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), index=True)
    kind: Mapped[str] = mapped_column(String(32))
    document: Mapped[str] = mapped_column(Text)
    opened_at: Mapped[datetime]
    purged_at: Mapped[datetime | None]
    """From then on its matches are stored but not counted."""


class MatchTable(Base):
    """The ledger: one block of games.

    Contestants and seed follow from the schedule. League and contestants are repeated here, so that listings do
    not read schedules.
    """

    __tablename__ = "matches"
    __table_args__ = (
        Index("ix_matches_league_played_at", "league", "played_at"),
        Index("ix_matches_league_first_second_played_at", "league", "first", "second", "played_at"),
    )

    schedule: Mapped[str] = mapped_column(ForeignKey("schedules.id"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    league: Mapped[str] = mapped_column(String(255))
    first: Mapped[str] = mapped_column(Text)
    second: Mapped[str] = mapped_column(Text)
    games: Mapped[int]
    scores: Mapped[str] = mapped_column(Text)
    returns: Mapped[str] = mapped_column(Text)
    """Sums over the games per contestant, a JSON list."""
    moves: Mapped[str] = mapped_column(Text)
    """The complete games, as written by `league.results.records.dump_games`."""
    played_at: Mapped[datetime]


class ScheduleTotalTable(Base):
    """What is recorded of a schedule. The row is the lock for adding matches to it."""

    __tablename__ = "schedule_totals"
    __table_args__ = (Index("ix_schedule_totals_league_matches", "league", "matches"),)

    schedule: Mapped[str] = mapped_column(ForeignKey("schedules.id"), primary_key=True)
    league: Mapped[str] = mapped_column(String(255))
    matches: Mapped[int] = mapped_column(BigInteger, default=0)
    size: Mapped[int] = mapped_column(BigInteger, default=0)
    """Characters of the recorded games."""


class PairSumTable(Base):
    """Sums over the matches of a schedule between two contestants, in alphabetical order."""

    __tablename__ = "pair_sums"

    schedule: Mapped[str] = mapped_column(ForeignKey("schedules.id"), primary_key=True)
    first: Mapped[str] = mapped_column(Text, primary_key=True)
    second: Mapped[str] = mapped_column(Text, primary_key=True)
    league: Mapped[str] = mapped_column(String(255), index=True)
    sums: Mapped[str] = mapped_column(Text)
    """As written by `league.results.sums.PairSums.dump`."""
    examples: Mapped[str] = mapped_column(Text)
    """As written by `league.results.sums.dump_examples`."""


class GameDigestTable(Base):
    """Digests of the games at STRIPE successive positions of a schedule, to count games without copies."""

    __tablename__ = "game_digests"

    schedule: Mapped[str] = mapped_column(ForeignKey("schedules.id"), primary_key=True)
    stripe: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    """The first position divided by STRIPE."""
    league: Mapped[str] = mapped_column(String(255), index=True)
    digests: Mapped[bytes] = mapped_column(LargeBinary)
    """DIGEST_BYTES for each position in order, up to the last match; zeros at positions without a match."""


STRIPE = 512
"""Positions in a row of digests."""
DIGEST_BYTES = 16
"""Bytes of the digests of a match: an integer of 8 bytes for each of the two games, least significant first."""
