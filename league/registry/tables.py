"""The registry's tables. A change here needs a migration beside it: `migrations/versions/`."""

from datetime import UTC, datetime
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    DateTime,
    Dialect,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    MetaData,
    String,
    Text,
    TypeDecorator,
    text,
)
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

PUBLISHING, READY, ABANDONED = "publishing", "ready", "abandoned"
"""The states of a version: only `ready` ones exist for anybody but their publisher."""


class Utc(TypeDecorator[datetime]):
    """An instant. SQLite has no time zones: there it is stored as naive UTC."""

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


class Table(DeclarativeBase):
    """Names every constraint, so that a migration can drop it on any database."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class League(Table):
    """A registered league. Its row is the lock of every change below it."""

    __tablename__ = "leagues"

    slug: Mapped[str] = mapped_column(String(255), primary_key=True)
    config: Mapped[dict[str, Any]] = mapped_column(JSON)
    interface: Mapped[dict[str, Any]] = mapped_column(JSON)
    interface_digest: Mapped[str] = mapped_column(String(64))
    environment_digest: Mapped[str] = mapped_column(String(64))
    last_version: Mapped[int]
    """The highest number ever reserved. Numbers are not used again, whatever became of them."""
    registered_at: Mapped[datetime] = mapped_column(Utc)


class Version(Table):
    """A checkpoint version: reserved (`publishing`), whole (`ready`), or to be cleared away (`abandoned`)."""

    __tablename__ = "versions"
    __table_args__ = (
        Index(
            "uq_versions_ready_source",
            "league",
            "source",
            unique=True,
            sqlite_where=text("state = 'ready'"),
            postgresql_where=text("state = 'ready'"),
        ),
        ForeignKeyConstraint(["league", "parent"], ["versions.league", "versions.number"]),
    )

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    state: Mapped[str] = mapped_column(String(16))
    source: Mapped[str] = mapped_column(Text)
    parent: Mapped[int | None]
    publisher: Mapped[str] = mapped_column(Text)
    """The process that writes it, see publisher.py."""
    reserved_at: Mapped[datetime] = mapped_column(Utc)
    manifest: Mapped[str | None] = mapped_column(Text)
    """manifest.json, byte for byte; null until ready."""
    sha256: Mapped[str | None] = mapped_column(String(64))
    """The digest of manifest.json, which holds the digests of all other files."""


class VersionNote(Table):
    """What somebody wrote of a version. Never changed; the newest is its note, an empty one takes it away."""

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
    at: Mapped[datetime] = mapped_column(Utc)


class AliasEvent(Table):
    """One movement of an alias: who, when, why, on which verdict. Never changed."""

    __tablename__ = "alias_events"
    __table_args__ = (
        ForeignKeyConstraint(["league", "version"], ["versions.league", "versions.number"]),
        Index("ix_alias_events_league_alias_id", "league", "alias", "id"),
    )

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(String(255))
    alias: Mapped[str] = mapped_column(String(255))
    kind: Mapped[str] = mapped_column(String(16))
    version: Mapped[int]
    previous: Mapped[int | None]
    beneath: Mapped[int | None] = mapped_column(ForeignKey("alias_events.id"))
    """The event that a rollback of this one returns to."""
    actor: Mapped[str] = mapped_column(Text)
    reason: Mapped[str] = mapped_column(Text)
    verdict: Mapped[str | None] = mapped_column(ForeignKey("verdicts.id"))
    at: Mapped[datetime] = mapped_column(Utc)


class Alias(Table):
    """Where an alias points now, and the event that put it there."""

    __tablename__ = "aliases"
    __table_args__ = (ForeignKeyConstraint(["league", "version"], ["versions.league", "versions.number"]),)

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), primary_key=True)
    version: Mapped[int]
    event: Mapped[int] = mapped_column(ForeignKey("alias_events.id"))


class Acknowledgement(Table):
    """What a serving replica says that it serves."""

    __tablename__ = "acknowledgements"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    version: Mapped[int | None]
    sha256: Mapped[str | None] = mapped_column(String(64))
    fault: Mapped[str | None] = mapped_column(Text)
    aliases: Mapped[dict[str, int]] = mapped_column(JSON)
    """alias → the version that answers for it"""
    traffic: Mapped[int | None]
    """The setting of canary and shadow that it follows."""
    seen_at: Mapped[datetime] = mapped_column(Utc, index=True)


class TrafficEvent(Table):
    """What a league's canary and shadow were set to, by whom and why. Never changed; the newest is in force."""

    __tablename__ = "traffic_events"
    __table_args__ = (Index("ix_traffic_events_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    canary: Mapped[str | None] = mapped_column(String(255))
    """A number or an alias."""
    canary_share: Mapped[float | None] = mapped_column(Double)
    shadow: Mapped[str | None] = mapped_column(String(255))
    shadow_share: Mapped[float | None] = mapped_column(Double)
    actor: Mapped[str] = mapped_column(Text)
    reason: Mapped[str] = mapped_column(Text)
    at: Mapped[datetime] = mapped_column(Utc)


class ShadowCount(Table):
    """What a replica has counted of a candidate that requests for the champion were mirrored to, since it started."""

    __tablename__ = "shadow_counts"
    __table_args__ = (
        ForeignKeyConstraint(["league", "candidate"], ["versions.league", "versions.number"]),
        ForeignKeyConstraint(["league", "champion"], ["versions.league", "versions.number"]),
    )

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    candidate: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    champion: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    requests: Mapped[int] = mapped_column(BigInteger)
    observations: Mapped[int] = mapped_column(BigInteger)
    agreed: Mapped[int] = mapped_column(BigInteger)
    failed: Mapped[int] = mapped_column(BigInteger)
    dropped: Mapped[int] = mapped_column(BigInteger)
    skipped: Mapped[int] = mapped_column(BigInteger)
    latency: Mapped[list[int]] = mapped_column(JSON)
    """Counts in the buckets of league/histograms.py."""
    ns: Mapped[int] = mapped_column(BigInteger)
    at: Mapped[datetime] = mapped_column(Utc, index=True)


class Report(Table):
    """What a replica measures of itself, as serve_app/metrics.py writes it."""

    __tablename__ = "reports"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    document: Mapped[dict[str, Any]] = mapped_column(JSON)
    at: Mapped[datetime] = mapped_column(Utc, index=True)


class ApiKey(Table):
    """A key that a caller shows. Never removed: `revoked_at` ends it."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(8), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    """The digest of the key's text, which is kept nowhere."""
    scopes: Mapped[list[str]] = mapped_column(JSON)
    leagues: Mapped[list[str] | None] = mapped_column(JSON(none_as_null=True))
    rate: Mapped[float | None] = mapped_column(Double)
    created_at: Mapped[datetime] = mapped_column(Utc)
    expires_at: Mapped[datetime | None] = mapped_column(Utc)
    revoked_at: Mapped[datetime | None] = mapped_column(Utc)


class IdempotentCall(Table):
    """A change that a caller named, and what it led to: an event of an alias or of traffic, or an evaluation."""

    __tablename__ = "idempotent_calls"

    owner: Mapped[str] = mapped_column(ForeignKey("api_keys.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    digest: Mapped[str] = mapped_column(String(64))
    """Of what was asked."""
    event: Mapped[int | None] = mapped_column(ForeignKey("alias_events.id"))
    traffic: Mapped[int | None] = mapped_column(ForeignKey("traffic_events.id"))
    evaluation: Mapped[int | None] = mapped_column(ForeignKey("evaluations.id"))
    at: Mapped[datetime] = mapped_column(Utc, index=True)


class Schedule(Table):
    """What is to be played. `sequence` is the order in which schedules were opened."""

    __tablename__ = "schedules"

    sequence: Mapped[int] = mapped_column(primary_key=True)
    id: Mapped[str] = mapped_column(String(255), unique=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), index=True)
    kind: Mapped[str] = mapped_column(String(32))
    document: Mapped[str] = mapped_column(Text)
    opened_at: Mapped[datetime] = mapped_column(Utc)
    purged_at: Mapped[datetime | None] = mapped_column(Utc)
    """From then on its matches count for nothing, though they stay."""


class Match(Table):
    """The ledger: one block of games. Who played, and from which seed, follows from the schedule; league and
    contestants are here too, so that lists of matches need no schedule."""

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
    """Sums over the games for each contestant, a JSON list: all that ratings read."""
    moves: Mapped[str] = mapped_column(Text)
    """The games whole: what `results/documents.py` writes."""
    played_at: Mapped[datetime] = mapped_column(Utc)


class Verdict(Table):
    """What a gate is deciding (`outcome` is null) or has decided, with its evidence."""

    __tablename__ = "verdicts"
    __table_args__ = (ForeignKeyConstraint(["league", "candidate"], ["versions.league", "versions.number"]),)

    id: Mapped[str] = mapped_column(String(255), primary_key=True)
    """That of the schedule whose matches it counts."""
    league: Mapped[str] = mapped_column(String(255), index=True)
    candidate: Mapped[int]
    champion: Mapped[str] = mapped_column(Text)
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    outcome: Mapped[str | None] = mapped_column(String(16))
    evidence: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    opened_at: Mapped[datetime] = mapped_column(Utc)
    closed_at: Mapped[datetime | None] = mapped_column(Utc)


class Night(Table):
    """One night of a league: who was to be judged, and what came of it. Open until `ended_at`."""

    __tablename__ = "nights"
    __table_args__ = (Index("ix_nights_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    candidates: Mapped[list[int]] = mapped_column(JSON)
    """Version numbers."""
    alpha: Mapped[float] = mapped_column(Double)
    """What each of their verdicts may spend."""
    report: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    began_at: Mapped[datetime] = mapped_column(Utc)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class Evaluation(Table):
    """An evaluation that was asked of the service: what it is to play, who plays it, how far it is, what it brought."""

    __tablename__ = "evaluations"
    __table_args__ = (Index("ix_evaluations_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    asked: Mapped[dict[str, Any]] = mapped_column(JSON)
    """What league/evaluations.py reads."""
    state: Mapped[str] = mapped_column(String(16), index=True)
    progress: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    error: Mapped[dict[str, str] | None] = mapped_column(JSON(none_as_null=True))
    """`code` and `message` of what made it fail."""
    actor: Mapped[str] = mapped_column(Text)
    key: Mapped[str | None] = mapped_column(ForeignKey("api_keys.id"))
    """The API key that asked for it."""
    reason: Mapped[str | None] = mapped_column(Text)
    workers: Mapped[int | None]
    """Processes that play at once."""
    runner: Mapped[str | None] = mapped_column(String(64))
    """The process that plays it, or did last."""
    attempts: Mapped[int]
    """Runners that began since it last got on."""
    created_at: Mapped[datetime] = mapped_column(Utc)
    started_at: Mapped[datetime | None] = mapped_column(Utc)
    heartbeat_at: Mapped[datetime | None] = mapped_column(Utc)
    stop_at: Mapped[datetime | None] = mapped_column(Utc)
    """When somebody asked for its end."""
    stopped_by: Mapped[str | None] = mapped_column(Text)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class Snapshot(Table):
    """A part of what pages show of a league, computed ahead of time: see evaluation/snapshots.py."""

    __tablename__ = "snapshots"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    part: Mapped[str] = mapped_column(String(300), primary_key=True)
    mark: Mapped[str] = mapped_column(Text)
    """Of what it was computed from: another mark, another document."""
    document: Mapped[Any] = mapped_column(JSON)
    at: Mapped[datetime] = mapped_column(Utc)


class Run(Table):
    """A training run, as its driver tells of it."""

    __tablename__ = "runs"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    algorithm: Mapped[str] = mapped_column(String(32))
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    seed: Mapped[int] = mapped_column(BigInteger)
    target: Mapped[int] = mapped_column(BigInteger)
    """Steps at which it ends."""
    parent: Mapped[int | None]
    """The version that it trains on from."""
    state: Mapped[str] = mapped_column(String(16))
    error: Mapped[str | None] = mapped_column(Text)
    lives: Mapped[int]
    """How often it was begun or gone on with."""
    steps: Mapped[int] = mapped_column(BigInteger)
    seconds: Mapped[float] = mapped_column(Double)
    curves: Mapped[dict[str, float]] = mapped_column(JSON)
    """The newest value of each."""
    spacing: Mapped[int] = mapped_column(BigInteger)
    """Steps between two points at least, so that there are never too many."""
    began_at: Mapped[datetime] = mapped_column(Utc)
    heartbeat_at: Mapped[datetime] = mapped_column(Utc)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class RunPoint(Table):
    """Where the curves of a run were after so many steps."""

    __tablename__ = "run_points"
    __table_args__ = (ForeignKeyConstraint(["league", "run"], ["runs.league", "runs.id"]),)

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    run: Mapped[str] = mapped_column(String(64), primary_key=True)
    steps: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    curves: Mapped[dict[str, float]] = mapped_column(JSON)
    at: Mapped[datetime] = mapped_column(Utc)
