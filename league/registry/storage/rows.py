"""Immutable records that the registry returns, detached from database sessions.

A record that is one row is the class of its table.
"""

from collections.abc import Mapping
from dataclasses import FrozenInstanceError, dataclass, field
from datetime import UTC, datetime, timedelta
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from sqlalchemy import JSON, BigInteger, ForeignKey, ForeignKeyConstraint, Index, String, Text, inspect
from sqlalchemy.orm import Mapped, MappedAsDataclass, mapped_column

from league.conditions import Conditions, action_selection
from league.errors import InvalidInput, LeagueArchived
from league.histograms import Histogram
from league.interface import Interface
from league.refs import short_verdict
from league.registry.storage.manifest import Manifest, Mixture, Role, SearchSettings, trained_role
from league.registry.storage.tables import Base

if TYPE_CHECKING:
    from league.config.gate import GateConfig
    from league.config.league import LeagueConfig


class Record(MappedAsDataclass, Base):
    """A row of a table. It can be changed in the transaction that has read or created it, and not afterwards."""

    __abstract__ = True

    def __setattr__(self, name: str, value: object) -> None:
        state = inspect(self, raiseerr=False)
        if state is not None and state.detached:
            raise FrozenInstanceError(f"{name} of {type(self).__name__} cannot be set: its transaction has ended")
        super().__setattr__(name, value)


class LeagueRow(Record, kw_only=True):
    """A registered league. Its row is the lock for all changes to the league."""

    __tablename__ = "leagues"

    slug: Mapped[str] = mapped_column(String(255), primary_key=True)
    config_document: Mapped[dict[str, Any]] = mapped_column("config")
    interface_document: Mapped[dict[str, Any]] = mapped_column("interface")
    interface_digest: Mapped[str] = mapped_column(String(64))
    environment_digest: Mapped[str] = mapped_column(String(64))
    game: Mapped[dict[str, Any]]
    """What decides results, see `LeagueConfig.game`."""
    game_digest: Mapped[str] = mapped_column(String(64))
    """SHA-256 of `game`. Only results with the same digest are combined."""
    last_version: Mapped[int]
    """The highest number ever reserved. Numbers are never reused."""
    registered_at: Mapped[datetime]
    archived_at: Mapped[datetime | None]
    """Since when nothing is trained, published or tested."""

    @cached_property
    def config(self) -> "LeagueConfig":
        """Raises ConfigError if it is one of another release."""
        from league.config.league import LeagueConfig  # Takes 0.05 s to import, and most commands read versions only.

        return LeagueConfig.from_mapping(self.config_document, source=f"the registered league {self.slug}")

    @cached_property
    def interface(self) -> Interface:
        return Interface.model_validate(self.interface_document)

    def require_active(self) -> None:
        """Raise LeagueArchived if the league is archived."""
        if self.archived_at is not None:
            raise LeagueArchived(
                f"league {self.slug} is archived: `league archive {self.slug} --undo` makes it active again"
            )

    @property
    def conditions(self) -> Conditions:
        """The conditions of the games that count."""
        return Conditions(self.game_digest, action_selection(self.config, self.interface))


class EarlierGameRow(Record, kw_only=True):
    """A game that a league had before its environment's code or its rules changed. Its results are kept apart."""

    __tablename__ = "earlier_games"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    digest: Mapped[str] = mapped_column(String(64), primary_key=True)
    game: Mapped[dict[str, Any]]
    """See `LeagueConfig.game`."""
    replaced_at: Mapped[datetime]
    """When the league had this game last."""


@dataclass(frozen=True, slots=True)
class Note:
    """A note on a version."""

    text: str
    actor: str
    at: datetime


@dataclass(frozen=True, slots=True)
class VersionRow:
    """A published checkpoint version."""

    league: str
    number: int
    source: str
    """The checkpoint that it was published from."""
    sha256: str
    """Digest of manifest.json, and thereby of the version."""
    manifest: Manifest
    aliases: tuple[str, ...]
    note: Note | None
    retired_at: datetime | None
    """When its files were removed."""

    @property
    def ref(self) -> str:
        return f"{self.league}@{self.number}"

    @property
    def run(self) -> str:
        """Id of the training run that published it."""
        return self.source.partition("/")[0]

    @property
    def parent(self) -> int | None:
        return self.manifest.parent

    @property
    def role(self) -> Role:
        return self.manifest.role

    @property
    def exploits(self) -> str | None:
        """The version that an exploiter was trained against."""
        return self.manifest.exploits

    @property
    def mixture(self) -> Mixture | None:
        """The versions of a mixture; None for other versions."""
        return self.manifest.mixture

    @property
    def search(self) -> SearchSettings | None:
        """The search of a search version; None for other versions."""
        return self.manifest.search

    def require_policies(self) -> None:
        """Raise InvalidInput, which names the versions that play, if the version has no policies of its own."""
        if self.search is not None:
            raise InvalidInput(f"{self.ref} searches ({self.search}): name @{self.search.version} instead")
        if self.mixture is not None:
            raise InvalidInput(f"{self.ref} is a mixture ({self.mixture}): name one of its members")

    @property
    def steps(self) -> int:
        return self.manifest.steps

    @property
    def created_at(self) -> datetime:
        return self.manifest.created_at


class AliasEvent(Record, kw_only=True):
    """A change of an alias with actor, reason and verdict. Never changed."""

    __tablename__ = "alias_events"
    __table_args__ = (
        ForeignKeyConstraint(["league", "version"], ["versions.league", "versions.number"]),
        Index("ix_alias_events_league_alias_id", "league", "alias", "id"),
    )

    id: Mapped[int] = mapped_column(primary_key=True, default=None)
    league: Mapped[str] = mapped_column(String(255))
    alias: Mapped[str] = mapped_column(String(255))
    kind: Mapped[Literal["set", "rollback"]] = mapped_column(String(16))
    version: Mapped[int]
    previous: Mapped[int | None]
    """The version that it pointed to before the change."""
    beneath: Mapped[int | None] = mapped_column(ForeignKey("alias_events.id"))
    """The event that a rollback of this one returns to."""
    actor: Mapped[str] = mapped_column(Text)
    reason: Mapped[str] = mapped_column(Text)
    verdict: Mapped[str | None] = mapped_column(ForeignKey("verdicts.id"))
    at: Mapped[datetime]


class ChangeCounts(NamedTuple):
    """How often what replicas follow has changed."""

    aliases: int
    traffic: int
    keys: int
    leagues: int
    """Leagues that were registered or have changed how versions select actions, and versions that were retired or
    removed."""

    @property
    def to_acknowledge(self) -> int:
        """Changes that replicas acknowledge: those of aliases and traffic settings."""
        return self.aliases + self.traffic


class ReadPosition(NamedTuple):
    """How far a replica has read."""

    changes: int
    """Changes of aliases and traffic settings."""
    event: int
    """Id of the newest alias event, 0 if there is none."""
    traffic: int
    """Id of the newest traffic setting, 0 if there is none."""


@dataclass(frozen=True, slots=True)
class ServedState:
    """What a replica serves of a league. `version` is None while it serves nothing."""

    version: int | None = None
    sha256: str | None = None
    fault: str | None = None
    """Why it does not serve what it should, if so."""
    aliases: Mapping[str, int] = field(default_factory=dict)
    """alias → version that it serves"""
    event: int | None = None
    """Id of the newest alias event of the league that it has read; None if it has not reported on the league."""
    traffic: int | None = None
    """Id of the traffic setting that it follows completely."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement(ServedState):
    """What a replica has reported that it serves of a league. Times as in RegisteredReplica."""

    replica: str
    league: str
    seen_at: datetime
    silence: timedelta


class VersionState(NamedTuple):
    """What a published version is now."""

    sha256: str
    """Digest of its manifest."""
    is_retired: bool


class AliasTarget(NamedTuple):
    """What an alias points to."""

    version: int
    event: int
    """Id of the event that set it."""


@dataclass(frozen=True, slots=True)
class RegisteredReplica:
    """A replica that has started and has not deregistered."""

    replica: str
    process: dict[str, str]
    """Where it runs: from this, other replicas can tell that it has ended."""
    seen_at: datetime
    """Time of its last report, by the clock of the database."""
    silence: timedelta
    """Time since its last report, by the clock of the database."""


@dataclass(frozen=True, slots=True)
class Portion:
    """A version, by number or alias, and its share of requests, from 0 to 1."""

    version: int | str
    share: float


@dataclass(frozen=True, slots=True)
class Traffic:
    """Canary and shadow of a league. `id` is None if none was ever set."""

    league: str
    id: int | None = None
    canary: Portion | None = None
    """Answers its share of requests instead of the champion."""
    shadow: Portion | None = None
    """Gets a copy of its share of requests after the champion has answered."""
    actor: str | None = None
    reason: str | None = None
    at: datetime | None = None


class ShadowCounts(Record):
    """Comparison of a shadow with the champion on mirrored requests: since a replica started, or the sums over all."""

    __tablename__ = "shadow_counts"
    __table_args__ = (
        ForeignKeyConstraint(["league", "candidate"], ["versions.league", "versions.number"]),
        ForeignKeyConstraint(["league", "champion"], ["versions.league", "versions.number"]),
    )

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    candidate: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    champion: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    requests: Mapped[int] = mapped_column(BigInteger)
    """Mirrored requests that were compared."""
    observations: Mapped[int] = mapped_column(BigInteger)
    """Observations in those requests."""
    agreed: Mapped[int] = mapped_column(BigInteger)
    """Observations with the same action; if actions are sampled, with the same random numbers."""
    failed: Mapped[int] = mapped_column(BigInteger)
    """Requests that failed on the candidate."""
    dropped: Mapped[int] = mapped_column(BigInteger)
    """Requests that were not mirrored because the queue was full."""
    skipped: Mapped[int] = mapped_column(BigInteger)
    """Requests that cannot be mirrored because their recurrent state belongs to another network."""
    latency: Mapped[list[int]]
    """Histogram (buckets of league/histograms.py) of the candidate's computing time per request."""
    ns: Mapped[int] = mapped_column(BigInteger)
    """Sum of those times in nanoseconds."""
    replica: Mapped[str] = mapped_column(String(255), primary_key=True, init=False, compare=False)
    at: Mapped[datetime] = mapped_column(index=True, init=False, compare=False)

    @property
    def agreement(self) -> float | None:
        return self.agreed / self.observations if self.observations else None

    def milliseconds(self, share: float) -> float | None:
        """Return the `share` quantile of the computing time; see `Histogram.quantile`."""
        return Histogram(self.latency).quantile(share)


class KeyRow(Record, kw_only=True):
    """An API key without its text, which is not stored. Rows are never deleted: `revoked_at` ends a key."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(String(8), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), unique=True)
    sha256: Mapped[str] = mapped_column(String(64), unique=True)
    """Digest of the key's text."""
    scopes: Mapped[frozenset[str]]
    leagues: Mapped[frozenset[str] | None]
    """Leagues that it is valid for; None: all."""
    rate: Mapped[float | None]
    """Requests per second at each replica; None: unlimited."""
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]

    def is_valid(self, now: datetime) -> bool:
        """Return whether the key is neither revoked nor expired."""
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


class VerdictRow(Record, kw_only=True):
    """The decision of a gate on `candidate` against `champion`; outcome and evidence are None while it is open."""

    __tablename__ = "verdicts"
    __table_args__ = (ForeignKeyConstraint(["league", "candidate"], ["versions.league", "versions.number"]),)

    id: Mapped[str] = mapped_column(String(255), primary_key=True)
    """Id of the schedule whose matches it counts."""
    league: Mapped[str] = mapped_column(String(255), index=True)
    candidate: Mapped[int]
    champion: Mapped[str] = mapped_column(Text)
    """A reference: `connect_four@3`, or `script:random` if there was no champion."""
    settings: Mapped[dict[str, Any]]
    outcome: Mapped[str | None] = mapped_column(String(16))
    evidence: Mapped[dict[str, Any] | None]
    opened_at: Mapped[datetime]
    closed_at: Mapped[datetime | None]

    @property
    def schedule(self) -> str:
        return self.id

    @property
    def gate(self) -> "GateConfig":
        """The gate's settings when it was opened, including its α."""
        from league.config.gate import GateConfig

        return GateConfig.model_validate(self.settings["gate"])

    @property
    def tests(self) -> list[dict[str, Any]]:
        """The records of its tests after that against the champion, in the order in which they are played.

        Each has a `kind` and a `schedule`, which is None until its opponents are trained.
        """
        return list(self.settings.get("tests", ()))

    @property
    def confirmation(self) -> str | None:
        """Id of the schedule of its confirmation match, which has no influence on the decision."""
        return self.settings.get("confirmation")

    @property
    def tested_schedules(self) -> list[str]:
        """Ids of the schedules whose results decide the verdict, in order."""
        return [self.schedule, *(test["schedule"] for test in self.tests if test["schedule"] is not None)]

    @property
    def schedules(self) -> list[str]:
        """Ids of all schedules that belong to the verdict."""
        return [*self.tested_schedules, *([self.confirmation] if self.confirmation else [])]

    @property
    def short_id(self) -> str:
        """The short id for display."""
        return short_verdict(self.id)

    @property
    def candidate_ref(self) -> str:
        return f"{self.league}@{self.candidate}"

    @property
    def alpha(self) -> float:
        """The error probability that it spends of a year's alpha."""
        return float(self.settings["gate"]["alpha"])


class NightlyRunRow(Record, kw_only=True):
    """A nightly run of a league; `ended_at` and `report` are None while it runs."""

    __tablename__ = "nightly_runs"
    __table_args__ = (Index("ix_nightly_runs_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True, default=None)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    candidates: Mapped[tuple[int, ...]]
    """Version numbers."""
    alpha: Mapped[float]
    """Alpha of each verdict."""
    report: Mapped[dict[str, Any] | None] = mapped_column(default=None)
    began_at: Mapped[datetime]
    ended_at: Mapped[datetime | None] = mapped_column(default=None)


class TrainingNightRow(Record, kw_only=True):
    """A night of training of a league; `ended_at` is None while it runs."""

    __tablename__ = "training_nights"
    __table_args__ = (Index("ix_training_nights_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True, default=None)
    """Unique among all leagues."""
    number: Mapped[int]
    """Its place among the nights of the league, from 1."""
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    parent: Mapped[int | None]
    """The champion when it began, or without one the newest version."""
    steps: Mapped[dict[str, Any]]
    """step → result of each complete step"""
    began_at: Mapped[datetime]
    ended_at: Mapped[datetime | None] = mapped_column(default=None)

    @property
    def start(self) -> int | None:
        """The version that its training started from, which may be another one than `parent`; None: from scratch.

        `parent` before the end of training, and if it never began.
        """
        start: int | None = self.steps.get("train", {}).get("start", self.parent)
        return start

    @property
    def run(self) -> str:
        """Id of its training run."""
        return f"{self.began_at:%Y%m%d-%H%M%S}-night-{self.id}"

    @property
    def exploiter_run(self) -> str:
        """Id of the training run of its exploiter."""
        return f"{self.run}-exploiter"


EvaluationState = Literal["queued", "running", "done", "failed", "stopped"]


class EvaluationRow(Record, kw_only=True):
    """An evaluation that a client requested."""

    __tablename__ = "evaluations"
    __table_args__ = (Index("ix_evaluations_league_id", "league", "id"),)

    id: Mapped[int] = mapped_column(primary_key=True, default=None)
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"))
    request: Mapped[dict[str, Any]]
    """A document of league/service_requests.py."""
    state: Mapped[EvaluationState] = mapped_column(String(16), index=True)
    progress: Mapped[dict[str, Any] | None] = mapped_column(default=None)
    """`what`, `played` and `of`, about the games in progress."""
    result: Mapped[dict[str, Any] | None] = mapped_column(default=None)
    """The report, if done."""
    error: Mapped[dict[str, str] | None] = mapped_column(default=None)
    """`code` and `message`, if failed."""
    actor: Mapped[str] = mapped_column(Text)
    key: Mapped[str | None] = mapped_column(ForeignKey("api_keys.id"))
    """Id of the client's API key."""
    reason: Mapped[str | None] = mapped_column(Text)
    workers: Mapped[int | None] = mapped_column(default=None)
    """Number of concurrent worker processes."""
    runner: Mapped[str | None] = mapped_column(String(64), default=None)
    """The process that runs it, or ran it last."""
    attempts: Mapped[int] = mapped_column(default=0)
    """Runners that started since the last progress."""
    created_at: Mapped[datetime]
    started_at: Mapped[datetime | None] = mapped_column(default=None)
    heartbeat_at: Mapped[datetime | None] = mapped_column(default=None)
    stop_at: Mapped[datetime | None] = mapped_column(default=None)
    """When its end was requested."""
    stopped_by: Mapped[str | None] = mapped_column(Text, default=None)
    ended_at: Mapped[datetime | None] = mapped_column(default=None)


class SnapshotRow(Record, kw_only=True):
    """A precomputed document of a league, see evaluation/service/snapshots.py."""

    __tablename__ = "snapshots"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    part: Mapped[str] = mapped_column(String(300), primary_key=True)
    mark: Mapped[str] = mapped_column(Text)
    """Identifies the data that it was computed from."""
    document: Mapped[Any] = mapped_column(JSON)
    at: Mapped[datetime]


RunState = Literal["running", "silent", "ended", "failed", "stopped"]
HEARTBEAT_TIMEOUT = timedelta(minutes=1)
"""A run without a heartbeat for longer is silent."""


class RunRow(Record, kw_only=True):
    """A training run. `steps`, `seconds` of training and `curves` are the latest values that its driver reported."""

    __tablename__ = "runs"

    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), primary_key=True)
    id: Mapped[str] = mapped_column(String(64), primary_key=True)
    algorithm: Mapped[str] = mapped_column(String(32).with_variant(Text(), "postgresql"))
    settings: Mapped[dict[str, Any]]
    seed: Mapped[int] = mapped_column(BigInteger)
    target: Mapped[int | None] = mapped_column(BigInteger)
    """Steps at which it ends; None if only its time is limited."""
    parent: Mapped[int | None]
    """The version that training starts from."""
    exploits: Mapped[str | None] = mapped_column(Text)
    """The version that an exploiter is trained against."""
    reported_state: Mapped[RunState] = mapped_column("state", String(16))
    """The state without `silent`."""
    error: Mapped[str | None] = mapped_column(Text)
    attempts: Mapped[int]
    """How often it was started or resumed."""
    driver: Mapped[str] = mapped_column(Text)
    """The process that trains it, or trained it last, see `league.registry.processes.this_process`."""
    record: Mapped[dict[str, Any] | None] = mapped_column(deferred=True, compare=False, repr=False)
    """What another machine needs to continue it, the content of its file `run.json`; None if it cannot."""
    steps: Mapped[int] = mapped_column(BigInteger)
    seconds: Mapped[float]
    curves: Mapped[dict[str, float]]
    spacing: Mapped[int] = mapped_column(BigInteger)
    """Minimum steps between two points, which bounds their number."""
    began_at: Mapped[datetime]
    heartbeat_at: Mapped[datetime]
    ended_at: Mapped[datetime | None]

    @property
    def state(self) -> RunState:
        """`silent`: running without a recent heartbeat."""
        is_silent = self.reported_state == "running" and datetime.now(UTC) - self.heartbeat_at > HEARTBEAT_TIMEOUT
        return "silent" if is_silent else self.reported_state

    @property
    def role(self) -> Role:
        """The role of its versions."""
        return trained_role(self.exploits)


class RunPoint(Record):
    """Values of a run's curves at a step."""

    __tablename__ = "run_points"
    __table_args__ = (ForeignKeyConstraint(["league", "run"], ["runs.league", "runs.id"]),)

    league: Mapped[str] = mapped_column(String(255), primary_key=True)
    run: Mapped[str] = mapped_column(String(64), primary_key=True)
    steps: Mapped[int] = mapped_column(BigInteger, primary_key=True, autoincrement=False)
    curves: Mapped[dict[str, float]]
    at: Mapped[datetime]


class StrengthRow(Record, kw_only=True):
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
    score: Mapped[float]
    low: Mapped[float]
    high: Mapped[float]
    """Bounds of the 95 % interval."""
    at: Mapped[datetime]


Purpose = Literal["training", "evaluation"]


class Gateway(Record):
    """An open gateway."""

    __tablename__ = "gateways"

    url: Mapped[str] = mapped_column(String(255), primary_key=True)
    """The address of its WebSocket server."""
    token: Mapped[str] = mapped_column(String(255), primary_key=True)
    """The key that it expects."""
    league: Mapped[str] = mapped_column(ForeignKey("leagues.slug"), index=True)
    purpose: Mapped[Purpose] = mapped_column(String(32))
    """What its episodes are for."""
    simulators: Mapped[int] = mapped_column(default=0)
    """Number of simulators that are connected."""
    waiting: Mapped[int] = mapped_column(default=0)
    """Number of episodes that wait for one."""
    seen_at: Mapped[datetime] = mapped_column(init=False, compare=False)
    """When it was announced last, by the clock of the database."""

    @property
    def is_evaluation(self) -> bool:
        """Whether its episodes are matches of an evaluation."""
        return self.purpose == "evaluation"


@dataclass(frozen=True, slots=True)
class ChangeToken:
    """A summary of a league's state that differs after any change of the league."""

    league: str
    aliases: dict[str, int]
    event: int | None
    """Id of the newest alias event."""
    version: int | None
    """Number of the newest version."""
    note: int | None
    """Id of the newest note."""
    traffic: int | None
    """Id of the traffic setting in force."""
    serving: dict[int, int]
    """version → number of replicas that serve it as champion"""
    verdicts: dict[str, int]
    """outcome, or `open` → number of verdicts"""
    evaluation: int | None
    """Number of the newest evaluation."""
    evaluations: tuple[EvaluationRow, ...]
    """Queued and running evaluations."""
    run: str | None
    """Id of the newest training run."""
    runs: tuple[RunRow, ...]
    """Runs in state `running` or `silent`."""
    computed_at: datetime | None
    """When the newest snapshot was computed."""
