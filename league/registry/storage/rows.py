"""Immutable records that the registry returns, detached from database sessions."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from datetime import datetime, timedelta
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from league.conditions import Conditions, action_selection
from league.errors import LeagueArchived
from league.histograms import Histogram
from league.interface import Interface
from league.refs import short_verdict
from league.registry.storage.manifest import EXPLOITER, MAIN, Manifest, Role
from league.registry.storage.mixture import Mixture
from league.verdict_tests import CompanionTests

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from league.config.league import LeagueConfig

Record = TypeVar("Record", bound="DataclassInstance")


def detached(kind: type[Record], row: object, **converted: Any) -> Record:
    """Return the record of a table's row. converted: fields that differ from the column of the same name."""
    same = (field.name for field in fields(kind) if field.name not in converted)
    return kind(**{name: getattr(row, name) for name in same}, **converted)


def require_active(league: str, archived_at: datetime | None) -> None:
    """Raise LeagueArchived if a league is archived."""
    if archived_at is not None:
        raise LeagueArchived(f"league {league} is archived: `league archive {league} --undo` makes it active again")


@dataclass(frozen=True, slots=True)
class LeagueRow:
    """A registered league."""

    slug: str
    config: "LeagueConfig"
    interface: Interface
    interface_digest: str
    environment_digest: str
    game: dict[str, Any]
    """What decides results, see `LeagueConfig.game`."""
    game_digest: str
    """SHA-256 of `game`. Only results with the same digest are combined."""
    registered_at: datetime
    archived_at: datetime | None
    """Since when nothing is trained, published or tested."""

    def require_active(self) -> None:
        """Raise LeagueArchived if the league is archived."""
        require_active(self.slug, self.archived_at)

    @property
    def conditions(self) -> Conditions:
        """The conditions of the games that count."""
        return Conditions(self.game_digest, action_selection(self.config, self.interface))


@dataclass(frozen=True, slots=True)
class EarlierGameRow:
    """A game that a league had before its environment's code or its rules changed."""

    digest: str
    game: dict[str, Any]
    """See `LeagueConfig.game`."""
    replaced_at: datetime


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
    def steps(self) -> int:
        return self.manifest.steps

    @property
    def created_at(self) -> datetime:
        return self.manifest.created_at


@dataclass(frozen=True, slots=True)
class AliasEvent:
    """A change of an alias."""

    id: int
    league: str
    alias: str
    kind: Literal["set", "rollback"]
    version: int
    previous: int | None
    """The version that it pointed to before the change."""
    actor: str
    reason: str
    verdict: str | None
    at: datetime


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """What a replica serves of a league. `version` is None while it serves nothing."""

    replica: str
    league: str
    version: int | None
    sha256: str | None
    fault: str | None
    """Why it does not serve what it should, if so."""
    aliases: dict[str, int]
    """alias → version that it serves"""
    event: int | None
    """Id of the newest alias event of the league that it has read; None if it has not reported on the league."""
    traffic: int | None
    """Id of the traffic setting that it follows completely."""
    seen_at: datetime
    """Time of its last report, by the clock of the database."""
    silence: timedelta
    """Time since its last report, by the clock of the database."""


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
    """What a replica serves of a league. The fields are those of Acknowledgement."""

    version: int | None = None
    sha256: str | None = None
    fault: str | None = None
    aliases: Mapping[str, int] = field(default_factory=dict)
    event: int | None = None
    traffic: int | None = None


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


@dataclass(frozen=True, slots=True)
class ShadowCounts:
    """Comparison of a shadow with the champion on mirrored requests."""

    league: str
    candidate: int
    champion: int
    requests: int
    """Mirrored requests that were compared."""
    observations: int
    """Observations in those requests."""
    agreed: int
    """Observations with the same action; if actions are sampled, with the same random numbers."""
    failed: int
    """Requests that failed on the candidate."""
    dropped: int
    """Requests that were not mirrored because the queue was full."""
    skipped: int
    """Requests that cannot be mirrored because their recurrent state belongs to another network."""
    latency: tuple[int, ...]
    """Histogram (buckets of league/histograms.py) of the candidate's computing time per request."""
    ns: int
    """Sum of those times in nanoseconds."""

    @property
    def agreement(self) -> float | None:
        return self.agreed / self.observations if self.observations else None

    def milliseconds(self, share: float) -> float | None:
        """Return the `share` quantile of the computing time; see `Histogram.quantile`."""
        return Histogram(self.latency).quantile(share)


@dataclass(frozen=True, slots=True)
class KeyRow:
    """An API key without its text, which is not stored."""

    id: str
    name: str
    sha256: str
    """Digest of the key's text."""
    scopes: frozenset[str]
    leagues: frozenset[str] | None
    """Leagues that it is valid for; None: all."""
    rate: float | None
    """Requests per second at each replica; None: unlimited."""
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None

    def is_valid(self, now: datetime) -> bool:
        """Return whether the key is neither revoked nor expired."""
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """The decision of a gate on `candidate` against `champion`; outcome and evidence are None while it is open."""

    id: str
    """Id of the schedule whose matches it counts."""
    league: str
    candidate: int
    champion: str
    """A reference: `connect_four@3`, or `script:random` if there was no champion."""
    settings: dict[str, Any]
    outcome: str | None
    evidence: dict[str, Any] | None
    opened_at: datetime
    closed_at: datetime | None

    @property
    def schedule(self) -> str:
        return self.id

    @property
    def companions(self) -> CompanionTests:
        """Its tests after that against the champion."""
        return CompanionTests.of_settings(self.settings)

    @property
    def tested_schedules(self) -> list[str]:
        """Ids of the schedules whose results decide the verdict, in order."""
        return [self.schedule, *(test.schedule for test in self.companions.ready)]

    @property
    def contestants(self) -> set[str]:
        """References of all that play in its tests."""
        return {self.candidate_ref, self.champion} | self.companions.opponents

    @property
    def schedules(self) -> list[str]:
        """Ids of all schedules that belong to the verdict."""
        confirmation = self.companions.confirmation
        return [*self.tested_schedules, *([confirmation] if confirmation else [])]

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


@dataclass(frozen=True, slots=True)
class NightlyRunRow:
    """A nightly run of a league; `ended_at` and `report` are None while it runs."""

    id: int
    league: str
    candidates: tuple[int, ...]
    """Version numbers."""
    alpha: float
    """Alpha of each verdict."""
    report: dict[str, Any] | None
    began_at: datetime
    ended_at: datetime | None


@dataclass(frozen=True, slots=True)
class TrainingNightRow:
    """A night of training of a league; `ended_at` is None while it runs."""

    id: int
    """Unique among all leagues."""
    number: int
    """Its place among the nights of the league, from 1."""
    league: str
    parent: int | None
    """The champion when it began, or without one the newest version."""
    steps: dict[str, Any]
    """step → result of each complete step"""
    began_at: datetime
    ended_at: datetime | None

    @property
    def start(self) -> int | None:
        """The version that its training started from, which may be another one than `parent`; None: from scratch.

        `parent` before the end of training.
        """
        start: int | None = self.steps["train"]["start"] if "train" in self.steps else self.parent
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


@dataclass(frozen=True, slots=True)
class EvaluationRow:
    """An evaluation that a client requested."""

    id: int
    league: str
    request: dict[str, Any]
    state: EvaluationState
    progress: dict[str, Any] | None
    """`what`, `played` and `of`, about the games in progress."""
    result: dict[str, Any] | None
    """The report, if done."""
    error: dict[str, str] | None
    """`code` and `message`, if failed."""
    actor: str
    reason: str | None
    workers: int | None
    runner: str | None
    created_at: datetime
    started_at: datetime | None
    heartbeat_at: datetime | None
    stop_at: datetime | None
    stopped_by: str | None
    ended_at: datetime | None


@dataclass(frozen=True, slots=True)
class SnapshotRow:
    """A precomputed document of a league. `mark` identifies the data that it was computed from."""

    document: Any
    mark: str
    at: datetime


RunState = Literal["running", "silent", "ended", "failed", "stopped"]


@dataclass(frozen=True, slots=True)
class RunRow:
    """A training run. `steps`, `seconds` of training and `curves` are the latest reported values."""

    league: str
    id: str
    algorithm: str
    settings: dict[str, Any]
    seed: int
    target: int | None
    """Steps at which it ends; None if only its time is limited."""
    parent: int | None
    """The version that training starts from."""
    exploits: str | None
    """The version that an exploiter is trained against."""
    state: RunState
    """`silent`: running without a recent heartbeat."""
    error: str | None
    attempts: int
    """How often it was started or resumed."""
    steps: int
    seconds: float
    curves: dict[str, float]
    began_at: datetime
    heartbeat_at: datetime
    ended_at: datetime | None

    @property
    def role(self) -> Role:
        """The role of its versions."""
        return MAIN if self.exploits is None else EXPLOITER


@dataclass(frozen=True, slots=True)
class StoredRun:
    """What a machine needs to continue a training run that began on another one."""

    id: str
    state: RunState
    driver: str
    """The process that trains it, or trained it last, see `league.registry.processes.this_process`."""
    heartbeat_at: datetime
    record: dict[str, Any]
    """The content of its file `run.json`."""


@dataclass(frozen=True, slots=True)
class RunPoint:
    """Values of a run's curves at a step."""

    steps: int
    curves: dict[str, float]
    at: datetime


@dataclass(frozen=True, slots=True)
class StrengthRow:
    """The score of a version in the matches that its training run played against an opponent."""

    version: int
    steps: int
    opponent: str
    games: int
    score: float
    low: float
    high: float
    """Bounds of the 95 % interval."""
    at: datetime


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
