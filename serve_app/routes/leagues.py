"""Lists leagues, their versions and what each replica serves; writes notes on versions."""

from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timedelta
from typing import Annotated, Any, Literal

from pydantic import AliasPath, BaseModel, BeforeValidator, ConfigDict, Field

from league.conditions import ActionSelection
from league.errors import UnknownAlias, UnknownVersion
from league.policies.loading import baselines
from league.refs import CHAMPION, CheckpointRef, parse_version
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY
from league.registry.storage.manifest import Mixture
from league.registry.storage.rows import Note, VersionRow
from league.registry.versions import MAX_NOTE_LENGTH
from league.results.records import Scoring
from serve_app.access.api_keys import ApiKey
from serve_app.declaration import Declaration, Page, Response
from serve_app.observability.metrics_reporter import RequestCounts, request_counts
from serve_app.routes import documents
from serve_app.routes.documents import (
    Aliases,
    ComputedAt,
    MixtureMember,
    Number,
    Selection,
    StoredDocument,
    StoredTime,
    TrafficSetting,
    VerdictDecision,
    VersionSearch,
)

NO_REQUESTS = RequestCounts()
Members = Annotated[list[MixtureMember], Field(description="Versions of a mixture, with probabilities that sum to 1.")]
Digest = Annotated[
    str,
    Field(
        pattern="^[0-9a-f]{64}$",
        description="SHA-256 of the manifest.json of the version, which contains the digests of all its files.",
    ),
]


class Activity(Response):
    """The requests for the versions of a league."""

    requests: int = Field(description="Number of requests to the current replicas since they started.")
    requests_per_second: float = Field(description="Rate of all replicas over the last seconds.")


class ListedLeague(Activity):
    """A league with its champion and its current activity."""

    league: str
    champion: int | None
    aliases: Aliases
    versions: int = Field(description="Number of versions.")
    games: int | None = Field(description="Number of counted games at the last computation of the leaderboard.")
    matches: int | None
    last_verdict: VerdictDecision | None
    running_evaluations: int = Field(description="Number of evaluations, including queued ones.")
    running_runs: int = Field(description="Number of running training runs.")
    archived_at: datetime | None = Field(description="Since when the league is archived; null if it is not.")


class Space(StoredDocument):
    """The definition of a space."""

    type: Literal["box", "discrete", "multi_discrete", "multi_binary", "dict"]


class PolicySpaces(StoredDocument):
    """The spaces of a policy."""

    observation: Space
    action: Space


def _seconds(silence: timedelta) -> float:
    return max(0.0, silence.total_seconds())


class ServingReplica(Response):
    """What a replica serves of a league. It is listed until it deregisters or its process has ended."""

    replica: str
    version: int | None
    sha256: str | None
    aliases: Aliases
    fault: str | None
    event: int | None = Field(
        description="Id of the newest event of the league's aliases that it has read; null if it has not reported on"
        " the league."
    )
    seen_at: datetime = Field(description="Time of its last report, by the clock of the database.")
    silent_seconds: Annotated[float, BeforeValidator(_seconds)] = Field(
        ge=0, validation_alias="silence", description="Time since its last report, by the clock of the database."
    )


class Change(Response):
    """A part of a game that differs now."""

    name: str
    before: str | None
    now: str | None


class EarlierGame(Response):
    """Results from before the game of the league, or the selection of actions, changed."""

    name: str = Field(description="Value of `game` for the leaderboard and the payoff matrix.")
    actions: ActionSelection
    matches: int
    changes: list[Change] = Field(description="What of the game differs now; digests are abbreviated.")
    actions_changed: bool
    replaced_at: StoredTime | None


class UnexpectedGame(StoredDocument):
    """A game in which `better` scored `score` against `other`, although the ratings predicted `expected`."""

    match: str = Field(description="`schedule/position`")
    game: int
    better: str
    other: str
    expected: float
    score: float


class Summary(StoredDocument):
    """Counted games: those of the current game of the league, with its current sides and action selection."""

    games: int
    matches: int
    unique_games: int
    scoring: Scoring
    actions: ActionSelection
    sides: list[str]
    environment: str
    environment_digest: str
    upsets: list[UnexpectedGame] = Field(description="The games with the least expected results, greatest upset first.")
    earlier: list[EarlierGame] = Field(description="Newest first. They do not count.")


class League(Activity):
    """A league."""

    league: str
    environment: str
    actions: Selection
    champion: int | None
    aliases: Aliases
    mixtures: dict[str, Members] = Field(
        description="The members of the mixtures among the versions that aliases point to, by alias."
    )
    policies: dict[str, PolicySpaces]
    agents: dict[str, str] = Field(description="Policy by agent.")
    sides: dict[str, list[str]] = Field(description="Agents by side. With one side, all agents are a team.")
    baselines: list[str] = Field(
        description="Contestants besides the versions: scripts that can play the league, and the bots and remote models"
        " that its configuration names."
    )
    replicas: list[ServingReplica]
    faults: list[str]
    traffic: TrafficSetting
    summary: Summary | None
    computed_at: ComputedAt
    up_to_date: bool = Field(description="Whether leaderboard, payoffs and ratings include all games.")


class ListedVersion(Response):
    """A version."""

    version: Number = Field(validation_alias="number")
    aliases: list[str]
    sha256: Digest
    parent: int | None
    role: Literal["main", "exploiter", "mixture", "search"] = Field(
        description="An exploiter cannot become champion. A mixture has members, one of which plays each episode. A"
        " search version plays another version with a search."
    )
    exploits: str | None = Field(description="The version that an exploiter was trained against.")
    members: Members | None = Field(default=None, validation_alias=AliasPath("mixture", "members"))
    search: VersionSearch | None = Field(description="The search of a search version.")
    steps: int = Field(description="Number of environment steps of training.")
    algorithm: str = Field(validation_alias=AliasPath("manifest", "algorithm"))
    policies: Annotated[list[str], BeforeValidator(list)] = Field(validation_alias=AliasPath("manifest", "policies"))
    created_at: datetime
    retired_at: datetime | None = Field(description="When its files were removed.")
    note: Note | None


class NoteBody(BaseModel):
    """A note."""

    model_config = ConfigDict(extra="forbid", strict=True)

    note: str = Field(max_length=MAX_NOTE_LENGTH, pattern=r"^[^\x00]*$")


@Declaration("GET", "/v1/leagues", Page("leagues", ListedLeague, "league", is_whole=True), scope="read", tag="Read")
def leagues(registry: Registry, limit: int | None, before: str | None) -> Sequence[dict[str, Any]]:
    """List leagues.

    Ordered by name. Without `limit` and `before` all leagues are returned.
    """
    archived = registry.leagues.names()
    names = sorted(name for name in archived if before is None or name > before)[:limit]
    aliases: dict[str, dict[str, int]] = {league: {} for league in names}
    for (league, alias), target in registry.aliases.all().items():
        if league in aliases:
            aliases[league][alias] = target.version
    versions, verdicts = registry.versions.numbers(), registry.verdicts.last_closed()
    summaries = registry.snapshots.of_part(SUMMARY)
    evaluations, runs = registry.evaluations.counts(), registry.runs.counts()
    counts = request_counts(registry.replicas.reports().values())

    def document(league: str) -> dict[str, Any]:
        summary = summaries[league].document if league in summaries else {}
        return {
            "league": league,
            "champion": aliases[league].get(CHAMPION),
            "aliases": aliases[league],
            "versions": len(versions.get(league, ())),
            "games": summary.get("games"),
            "matches": summary.get("matches"),
            "last_verdict": documents.decision(verdicts[league]) if league in verdicts else None,
            "running_evaluations": sum(evaluations.get(league, {}).values()),
            "running_runs": runs.get(league, 0),
            "archived_at": archived[league],
        } | asdict(counts.get(league, NO_REQUESTS))

    return list(map(document, names))


@Declaration("GET", "/v1/leagues/{league}", League, scope="read", tag="Read")
def league(registry: Registry, league: str) -> dict[str, Any]:
    """Get a league.

    The aliases, the policies with their spaces, the version that each replica serves, and `faults`: the reasons why a
    replica does not serve the expected version.
    """
    row = registry.leagues.get(league)
    aliases = registry.aliases.current(league)
    compositions = registry.versions.compositions(league, set(aliases.values()))
    acknowledgements = registry.replicas.acknowledgements(league)
    counts = request_counts(registry.replicas.reports().values())
    summary = registry.snapshots.get(league, SUMMARY)
    interface = row.interface
    return {
        "league": league,
        "environment": row.config.environment.entry_point,
        "actions": row.conditions.actions,
        "champion": aliases.get(CHAMPION),
        "aliases": aliases,
        "mixtures": {
            alias: one.members
            for alias, number in aliases.items()
            if isinstance(one := compositions.get(number), Mixture)
        },
        "policies": {policy: interface.of_policy(policy).model_dump(mode="json") for policy in interface.policy_ids},
        "agents": interface.policies,
        "sides": interface.sides,
        "baselines": baselines(row.config, interface),
        "replicas": acknowledgements,
        "faults": sorted({acknowledgement.fault for acknowledgement in acknowledgements if acknowledgement.fault}),
        "traffic": registry.traffic.current(league),
        "summary": summary and summary.document,
        "computed_at": summary and summary.at,
        "up_to_date": summary is not None and summary.mark == registry.snapshots.current_marks()[league],
    } | asdict(counts.get(league, NO_REQUESTS))


@Declaration(
    "GET",
    "/v1/leagues/{league}/versions",
    Page("versions", ListedVersion, "version", is_whole=True),
    scope="read",
    tag="Read",
)
def versions(registry: Registry, league: str, limit: int | None, before: int | None) -> Sequence[VersionRow]:
    """List versions.

    Without `limit` and `before` all versions in ascending order; otherwise a page, newest first.
    """
    if limit is None:
        return registry.versions.all(league)
    return registry.versions.newest(league, before=before, limit=limit)


@Declaration(
    "GET",
    "/v1/leagues/{league}/versions/{version}",
    ListedVersion,
    scope="read",
    tag="Read",
    errors=(UnknownVersion, UnknownAlias),
)
def version(registry: Registry, league: str, version: str) -> VersionRow:
    """Get a version.

    By its number, or by an alias that names it now.
    """
    return registry.versions.resolve(CheckpointRef(league, parse_version(version)))


@Declaration(
    "PUT",
    "/v1/leagues/{league}/versions/{version}/note",
    ListedVersion,
    scope="promote",
    tag="Management",
    body=NoteBody,
    errors=(UnknownVersion, UnknownAlias),
)
def note(registry: Registry, league: str, version: str, body: NoteBody, key: ApiKey) -> VersionRow:
    """Set the note of a version.

    Replaces the previous note; an empty note deletes it. The name of the key is stored with the note. The call can be
    repeated, and needs no `Idempotency-Key`.
    """
    return registry.versions.set_note(CheckpointRef(league, parse_version(version)), body.note, actor=key.name)
