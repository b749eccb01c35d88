"""ORM classes of the registry's tables. Each change needs a migration in `migrations/versions/`."""

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


class Base(DeclarativeBase):
    """Base of the ORM classes. Names every constraint, so that a migration can drop it on any database."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class LeagueTable(Base):
    """A registered league. Its row is the lock for all changes to the league."""

    __tablename__ = "leagues"

    slug: Mapped[str] = mapped_column(String(255), primary_key=True)
    config: Mapped[dict[str, Any]] = mapped_column(JSON)
    interface: Mapped[dict[str, Any]] = mapped_column(JSON)
    interface_digest: Mapped[str] = mapped_column(String(64))
    environment_digest: Mapped[str] = mapped_column(String(64))
    game: Mapped[dict[str, Any]] = mapped_column(JSON)
    """What decides results, see LeagueConfig.game."""
    game_digest: Mapped[str] = mapped_column(String(64))
    last_version: Mapped[int]
    """The highest number ever reserved. Numbers are never reused."""
    registered_at: Mapped[datetime] = mapped_column(Utc)
    archived_at: Mapped[datetime | None] = mapped_column(Utc)


class EarlierGameTable(Base):
    """A game that a league had before its environment's code or its rules changed. Its results are kept apart."""

    __tablename__ = "earlier_games"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    digest: Mapped[str] = mapped_column(String(64), primary_key=True)
    game: Mapped[dict[str, Any]] = mapped_column(JSON)
    """As in `leagues`."""
    replaced_at: Mapped[datetime] = mapped_column(Utc)
    """When the league had this game last."""


class VersionTable(Base):
    """A checkpoint version: reserved (`publishing`), complete (`ready`), or to be removed (`abandoned`)."""

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
    role: Mapped[str] = mapped_column(String(16), default=MAIN)
    """As in the manifest."""
    exploits: Mapped[str | None] = mapped_column(Text)
    """As in the manifest."""
    publisher: Mapped[str] = mapped_column(Text)
    """The process that writes it, see `league.registry.processes.this_process`."""
    reserved_at: Mapped[datetime] = mapped_column(Utc)
    manifest: Mapped[str | None] = mapped_column(Text)
    """manifest.json, byte for byte; null until ready."""
    sha256: Mapped[str | None] = mapped_column(String(64))
    """Digest of manifest.json, which contains the digests of all other files."""
    retired_at: Mapped[datetime | None] = mapped_column(Utc)
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
    at: Mapped[datetime] = mapped_column(Utc)


class AliasEventTable(Base):
    """A change of an alias with actor, reason and verdict. Rows are immutable."""

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
    """What a replica serves of a league, while it differs from what the replica has read."""

    __tablename__ = "acknowledgements"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    version: Mapped[int | None]
    sha256: Mapped[str | None] = mapped_column(String(64))
    fault: Mapped[str | None] = mapped_column(Text)
    aliases: Mapped[dict[str, int]] = mapped_column(JSON)
    """alias → version that it serves"""
    traffic: Mapped[int | None]
    """Id of the traffic setting that it follows."""
    event: Mapped[int | None]
    """Id of the newest alias event of the league that it has read."""
    seen_at: Mapped[datetime] = mapped_column(Utc, index=True)


class ReplicaTable(Base):
    """A replica that has started and has not deregistered."""

    __tablename__ = "replicas"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    process: Mapped[dict[str, str]] = mapped_column(JSON)
    """Where it runs: from this, other replicas can tell that it has ended."""
    changes: Mapped[int | None] = mapped_column(BigInteger)
    """Changes that it has read, as in ReadPosition; null until it has read any."""
    event: Mapped[int | None]
    """Newest alias event that it has read, as in ReadPosition."""
    traffic: Mapped[int | None]
    """Newest traffic setting that it has read, as in ReadPosition."""
    seen_at: Mapped[datetime] = mapped_column(Utc, index=True)
    """Time of its last report, by the clock of the database."""


class TrafficEventTable(Base):
    """A setting of canary and shadow with actor and reason. Rows are immutable; the newest is in force."""

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


class ShadowCountTable(Base):
    """Counters of a replica for a shadow since the replica started."""

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


class ReplicaReportTable(Base):
    """Metrics of a replica, written by serve_app/observability/metrics.py."""

    __tablename__ = "reports"

    replica: Mapped[str] = mapped_column(String(255), primary_key=True)
    document: Mapped[dict[str, Any]] = mapped_column(JSON)
    at: Mapped[datetime] = mapped_column(Utc, index=True)


class ApiKeyTable(Base):
    """An API key. Rows are never deleted: `revoked_at` ends a key."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(8), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    """Digest of the key's text, which is not stored."""
    scopes: Mapped[list[str]] = mapped_column(JSON)
    leagues: Mapped[list[str] | None] = mapped_column(JSON(none_as_null=True))
    rate: Mapped[float | None] = mapped_column(Double)
    created_at: Mapped[datetime] = mapped_column(Utc)
    expires_at: Mapped[datetime | None] = mapped_column(Utc)
    revoked_at: Mapped[datetime | None] = mapped_column(Utc)


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
    at: Mapped[datetime] = mapped_column(Utc, index=True)


class ScheduleTable(Base):
    """A schedule of matches. `sequence` is the order in which schedules were opened."""

    __tablename__ = "schedules"

    sequence: Mapped[int] = mapped_column(primary_key=True)
    id: Mapped[str] = mapped_column(String(255), unique=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), index=True)
    kind: Mapped[str] = mapped_column(String(32))
    document: Mapped[str] = mapped_column(Text)
    opened_at: Mapped[datetime] = mapped_column(Utc)
    purged_at: Mapped[datetime | None] = mapped_column(Utc)
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
    """Sums over the games per contestant, a JSON list. Ratings read nothing else."""
    moves: Mapped[str] = mapped_column(Text)
    """The complete games, as written by `league.results.records.dump_games`."""
    played_at: Mapped[datetime] = mapped_column(Utc)


class VerdictTable(Base):
    """A verdict of a gate with its evidence. `outcome` is null while it is open."""

    __tablename__ = "verdicts"
    __table_args__ = (ForeignKeyConstraint(["league", "candidate"], ["versions.league", "versions.number"]),)

    id: Mapped[str] = mapped_column(String(255), primary_key=True)
    """Id of the schedule whose matches it counts."""
    league: Mapped[str] = mapped_column(String(255), index=True)
    candidate: Mapped[int]
    champion: Mapped[str] = mapped_column(Text)
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    outcome: Mapped[str | None] = mapped_column(String(16))
    evidence: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    opened_at: Mapped[datetime] = mapped_column(Utc)
    closed_at: Mapped[datetime | None] = mapped_column(Utc)


class NightlyRunTable(Base):
    """A nightly run with its candidates and its report. Open until `ended_at`."""

    __tablename__ = "nightly_runs"
    __table_args__ = (Index("ix_nightly_runs_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    candidates: Mapped[list[int]] = mapped_column(JSON)
    """Version numbers."""
    alpha: Mapped[float] = mapped_column(Double)
    """Alpha of each verdict."""
    report: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    began_at: Mapped[datetime] = mapped_column(Utc)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class TrainingNightTable(Base):
    """A night of training: the results of its steps. Open until `ended_at`."""

    __tablename__ = "training_nights"
    __table_args__ = (Index("ix_training_nights_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    parent: Mapped[int | None]
    """The version that training continues from."""
    steps: Mapped[dict[str, Any]] = mapped_column(JSON)
    """step → result of each complete step"""
    began_at: Mapped[datetime] = mapped_column(Utc)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class EvaluationTable(Base):
    """An evaluation with its request, runner, progress and result."""

    __tablename__ = "evaluations"
    __table_args__ = (Index("ix_evaluations_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    request: Mapped[dict[str, Any]] = mapped_column(JSON)
    """A document of league/service_requests.py."""
    state: Mapped[str] = mapped_column(String(16), index=True)
    progress: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON(none_as_null=True))
    error: Mapped[dict[str, str] | None] = mapped_column(JSON(none_as_null=True))
    """`code` and `message` of the error."""
    actor: Mapped[str] = mapped_column(Text)
    key: Mapped[str | None] = mapped_column(ForeignKey("api_keys.id"))
    """The API key of the client."""
    reason: Mapped[str | None] = mapped_column(Text)
    workers: Mapped[int | None]
    """Number of concurrent worker processes."""
    runner: Mapped[str | None] = mapped_column(String(64))
    """The process that runs it, or ran it last."""
    attempts: Mapped[int]
    """Runners that started since the last progress."""
    created_at: Mapped[datetime] = mapped_column(Utc)
    started_at: Mapped[datetime | None] = mapped_column(Utc)
    heartbeat_at: Mapped[datetime | None] = mapped_column(Utc)
    stop_at: Mapped[datetime | None] = mapped_column(Utc)
    """When its end was requested."""
    stopped_by: Mapped[str | None] = mapped_column(Text)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class SnapshotTable(Base):
    """A precomputed document of a league, see evaluation/service/snapshots.py."""

    __tablename__ = "snapshots"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    part: Mapped[str] = mapped_column(String(300), primary_key=True)
    mark: Mapped[str] = mapped_column(Text)
    """Identifies the data that it was computed from."""
    document: Mapped[Any] = mapped_column(JSON)
    at: Mapped[datetime] = mapped_column(Utc)


class RunTable(Base):
    """A training run, as reported by its driver."""

    __tablename__ = "runs"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    algorithm: Mapped[str] = mapped_column(String(32))
    settings: Mapped[dict[str, Any]] = mapped_column(JSON)
    seed: Mapped[int] = mapped_column(BigInteger)
    target: Mapped[int | None] = mapped_column(BigInteger)
    """Steps at which it ends, if they are limited."""
    parent: Mapped[int | None]
    """The version that training starts from."""
    exploits: Mapped[str | None] = mapped_column(Text)
    """The version that an exploiter is trained against."""
    state: Mapped[str] = mapped_column(String(16))
    error: Mapped[str | None] = mapped_column(Text)
    attempts: Mapped[int]
    """How often it was started or resumed."""
    driver: Mapped[str] = mapped_column(Text)
    """The process that trains it, or trained it last, see `league.registry.processes.this_process`."""
    record: Mapped[dict[str, Any] | None] = mapped_column(JSON, deferred=True)
    """What another machine needs to continue it; null if it cannot."""
    steps: Mapped[int] = mapped_column(BigInteger)
    seconds: Mapped[float] = mapped_column(Double)
    curves: Mapped[dict[str, float]] = mapped_column(JSON)
    """Latest value of each curve."""
    spacing: Mapped[int] = mapped_column(BigInteger)
    """Minimum steps between two points, which bounds their number."""
    began_at: Mapped[datetime] = mapped_column(Utc)
    heartbeat_at: Mapped[datetime] = mapped_column(Utc)
    ended_at: Mapped[datetime | None] = mapped_column(Utc)


class RunPointTable(Base):
    """Values of a run's curves at a step."""

    __tablename__ = "run_points"
    __table_args__ = (ForeignKeyConstraint(["league", "run"], ["runs.league", "runs.id"]),)

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    run: Mapped[str] = mapped_column(String(64), primary_key=True)
    steps: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    curves: Mapped[dict[str, float]] = mapped_column(JSON)
    at: Mapped[datetime] = mapped_column(Utc)


class StrengthTable(Base):
    """The score of a version in the matches that its training run played against an opponent."""

    __tablename__ = "strengths"
    __table_args__ = (
        ForeignKeyConstraint(["league", "version"], ["versions.league", "versions.number"]),
        Index("ix_strengths_league_run", "league", "run"),
    )

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    opponent: Mapped[str] = mapped_column(String(512), primary_key=True)
    """A fixed reference."""
    run: Mapped[str] = mapped_column(String(64))
    steps: Mapped[int] = mapped_column(BigInteger)
    """Actions of the run before the version, with those of its parent versions."""
    games: Mapped[int]
    score: Mapped[float] = mapped_column(Double)
    low: Mapped[float] = mapped_column(Double)
    high: Mapped[float] = mapped_column(Double)
    """Bounds of the 95 % interval."""
    at: Mapped[datetime] = mapped_column(Utc)
