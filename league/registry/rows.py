"""What the registry answers: plain frozen records, none tied to a database session."""

from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from league.config import LeagueConfig
from league.histograms import Histogram
from league.interface import Interface
from league.registry.manifest import Manifest


@dataclass(frozen=True, slots=True)
class LeagueRow:
    """A registered league."""

    slug: str
    config: LeagueConfig
    interface: Interface
    interface_digest: str
    environment_digest: str
    registered_at: datetime


@dataclass(frozen=True, slots=True)
class Note:
    """What somebody wrote of a version."""

    text: str
    actor: str
    at: datetime


@dataclass(frozen=True, slots=True)
class VersionRow:
    """A whole, published checkpoint version."""

    league: str
    number: int
    source: str
    """The checkpoint that it was made from."""
    sha256: str
    """The digest of manifest.json, and so of the version."""
    manifest: Manifest
    aliases: tuple[str, ...]
    note: Note | None

    @property
    def ref(self) -> str:
        return f"{self.league}@{self.number}"

    @property
    def parent(self) -> int | None:
        return self.manifest.parent

    @property
    def steps(self) -> int:
        return self.manifest.steps

    @property
    def created_at(self) -> datetime:
        return self.manifest.created_at


@dataclass(frozen=True, slots=True)
class AliasEvent:
    """One movement of an alias."""

    id: int
    league: str
    alias: str
    kind: Literal["set", "rollback"]
    version: int
    previous: int | None
    """The version that it pointed to before."""
    actor: str
    reason: str
    verdict: str | None
    at: datetime


@dataclass(frozen=True, slots=True)
class Acknowledgement:
    """What a serving replica serves of a league. `version` is None while it serves nothing of it."""

    replica: str
    league: str
    version: int | None
    sha256: str | None
    fault: str | None
    """Why it does not serve what it should."""
    aliases: dict[str, int]
    """alias → the version that answers for it"""
    seen_at: datetime
    traffic: int | None = None
    """The setting of canary and shadow that it follows whole."""


@dataclass(frozen=True, slots=True)
class Portion:
    """A version, by number or by alias, and the share of requests that it gets, from 0 to 1."""

    version: int | str
    share: float


@dataclass(frozen=True, slots=True)
class Traffic:
    """Where requests for a league's champion go besides. Without an id, nothing was ever set."""

    league: str
    id: int | None = None
    canary: Portion | None = None
    """Answers its share, instead of the champion."""
    shadow: Portion | None = None
    """Is shown its share, after the champion has answered."""
    actor: str | None = None
    reason: str | None = None
    at: datetime | None = None


@dataclass(frozen=True, slots=True)
class Shadowing:
    """A candidate's answers to requests that `champion` had answered."""

    league: str
    candidate: int
    champion: int
    requests: int
    """Mirrored and compared."""
    observations: int
    """In those requests."""
    agreed: int
    """Observations for which both take the same greedy action."""
    failed: int
    """Requests that the candidate could not answer."""
    dropped: int
    """Requests that were not mirrored because too many others were."""
    skipped: int
    """Requests that cannot be mirrored: with recurrent state, which is another network's."""
    latency: tuple[int, ...]
    """Counts in the buckets of league/histograms.py, of the time that the candidate computed for one request."""
    ns: int
    """The sum of those times in nanoseconds."""

    @property
    def agreement(self) -> float | None:
        return self.agreed / self.observations if self.observations else None

    def milliseconds(self, share: float) -> float | None:
        """Within which the candidate computed `share` of the requests; see `Histogram.quantile`."""
        return Histogram(self.latency).quantile(share)


@dataclass(frozen=True, slots=True)
class KeyRow:
    """An API key, as far as it is kept."""

    id: str
    name: str
    sha256: str
    """The digest of the key's text."""
    scopes: frozenset[str]
    leagues: frozenset[str] | None
    """Those that it is for; None: all."""
    rate: float | None
    """Requests per second, at each replica; None: unbounded."""
    created_at: datetime
    expires_at: datetime | None
    revoked_at: datetime | None

    def is_valid(self, now: datetime) -> bool:
        """Whether it opens a door."""
        return self.revoked_at is None and (self.expires_at is None or now < self.expires_at)


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """A gate's decision on `candidate` against `champion`; outcome and evidence are None until it is made."""

    id: str
    """The id of the schedule whose matches it counts."""
    league: str
    candidate: int
    champion: str
    """A reference: `connect_four@3`, or `script:random` where there was no champion."""
    settings: dict[str, Any]
    outcome: str | None
    evidence: dict[str, Any] | None
    opened_at: datetime
    closed_at: datetime | None

    @property
    def schedule(self) -> str:
        return self.id

    @property
    def alpha(self) -> float:
        """What it spends of a year's alpha."""
        return float(self.settings["gate"]["alpha"])


@dataclass(frozen=True, slots=True)
class NightRow:
    """One night of a league; `ended_at` and `report` are None while it goes on."""

    id: int
    league: str
    candidates: tuple[int, ...]
    """Versions to be judged."""
    alpha: float
    """What each of their verdicts may spend."""
    report: dict[str, Any] | None
    began_at: datetime
    ended_at: datetime | None


EvaluationState = Literal["queued", "running", "done", "failed", "stopped"]


@dataclass(frozen=True, slots=True)
class EvaluationRow:
    """An evaluation that was asked of the service."""

    id: int
    league: str
    asked: dict[str, Any]
    state: EvaluationState
    progress: dict[str, Any] | None
    """`what`, `played`, `of`: of the games that are played now."""
    result: dict[str, Any] | None
    """The report, once it is done."""
    error: dict[str, str] | None
    """`code` and `message`, where it failed."""
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
    """A part of what pages show of a league. `mark`: of what it was computed from."""

    document: Any
    mark: str
    at: datetime


RunState = Literal["running", "silent", "ended", "failed", "stopped"]


@dataclass(frozen=True, slots=True)
class RunRow:
    """A training run. `steps`, `seconds` of training and `curves` are the newest that are known."""

    league: str
    id: str
    algorithm: str
    settings: dict[str, Any]
    seed: int
    target: int
    """Steps at which it ends."""
    parent: int | None
    """The version that it trains on from."""
    state: RunState
    """`silent`: nobody has ended it, and nothing was heard of it for a while."""
    error: str | None
    lives: int
    """How often it was begun or gone on with."""
    steps: int
    seconds: float
    curves: dict[str, float]
    began_at: datetime
    heartbeat_at: datetime
    ended_at: datetime | None


@dataclass(frozen=True, slots=True)
class RunPoint:
    """Where the curves of a run were after so many steps."""

    steps: int
    curves: dict[str, float]
    at: datetime


@dataclass(frozen=True, slots=True)
class Pulse:
    """Where a league stands, in a few numbers: one of them is another whenever something of the league is."""

    league: str
    aliases: dict[str, int]
    event: int | None
    """The newest movement of an alias."""
    version: int | None
    """The newest."""
    note: int | None
    """The newest that was written of one of its versions."""
    traffic: int | None
    """The setting of canary and shadow."""
    serving: dict[int, int]
    """version → how many replicas it is the champion of."""
    verdicts: dict[str, int]
    """outcome, or `open` → how many."""
    evaluation: int | None
    """The newest."""
    evaluations: tuple[EvaluationRow, ...]
    """Those that are queued or running."""
    run: str | None
    """The newest training run."""
    runs: tuple[RunRow, ...]
    """Those that nobody has ended."""
    computed_at: datetime | None
    """When the newest of its snapshots was computed."""
