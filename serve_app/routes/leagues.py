"""Lists leagues, their versions and what each replica serves; writes notes on versions.

    GET  /v1/leagues                      by name; a page with ?limit= or &before=
    GET  /v1/leagues/{league}
    GET  /v1/leagues/{league}/versions    ascending; with ?limit= or &before= a page, newest first
    PUT  /v1/leagues/{league}/versions/{version}/note   {"note": "…"}

PUT requires an API key of scope `promote`, whose name is stored with the note. It replaces the note; an empty one
deletes it. PUT is idempotent and needs no `Idempotency-Key`.
"""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from league.policies.loading import baselines
from league.refs import CHAMPION, CheckpointRef, check_slug, parse_version
from league.registry.registry import Registry
from league.registry.snapshots import SUMMARY
from league.registry.storage.rows import Acknowledgement, VersionRow
from league.registry.versions import MAX_NOTE_LENGTH
from serve_app.access.access_control import DEADLINE, KEY
from serve_app.access.api_keys import ApiKey
from serve_app.access.request_body import MAX_CHANGE_BODY, read_body
from serve_app.models.resolver import ModelResolver
from serve_app.observability.metrics_reporter import RequestCounts, request_counts
from serve_app.routes import documents, parsing


class NoteBody(BaseModel):
    """The body of a note."""

    model_config = ConfigDict(extra="forbid", strict=True)

    note: str = Field(max_length=MAX_NOTE_LENGTH, pattern=r"^[^\x00]*$")


NO_REQUESTS = RequestCounts()


class LeagueRoutes:
    """The endpoints. Access control requires the scope `promote` for PUT."""

    def __init__(self, models: ModelResolver) -> None:
        self._models = models

    async def page(self, request: Request) -> Response:
        """Leagues with their champions and current activity. Raises InvalidInput."""
        limit = parsing.page_size(request) if _is_paged(request) else None
        before = parsing.query_name(request, "before")
        return await parsing.query_response(self._models, lambda registry: _leagues(registry, before, limit))

    async def get(self, request: Request) -> Response:
        """A league: aliases, policies, and what each replica serves. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])
        return await parsing.query_response(self._models, lambda registry: _league(registry, league))

    async def versions(self, request: Request) -> Response:
        """The versions of a league. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        if not _is_paged(request):
            return await parsing.query_response(self._models, lambda registry: _all_versions(registry, league))
        limit, before = parsing.page_size(request), parsing.query_number(request, "before")

        def query(registry: Registry) -> dict[str, Any]:
            rows = registry.versions.newest(league, before=before, limit=limit + 1)
            page, more = parsing.paginate(rows, limit, lambda row: row.number)
            return {"league": league, "versions": list(map(version_document, page)), "next": more}

        return await parsing.query_response(self._models, query)

    async def put_note(self, request: Request) -> JSONResponse:
        """Set the note of a version. Raises InvalidReference, UnknownLeague, UnknownVersion, UnknownAlias or
        InvalidInput.
        """
        league = check_slug("league", request.path_params["league"])
        ref = CheckpointRef(league, parse_version(request.path_params["version"]))
        body = parsing.parse_body(NoteBody, await read_body(request.scope, request.receive, MAX_CHANGE_BODY))
        key: ApiKey = request.scope[KEY]
        row = await self._models.change(
            lambda registry: registry.versions.set_note(ref, body.note, actor=key.name), request.scope[DEADLINE]
        )
        return JSONResponse(version_document(row))


def _is_paged(request: Request) -> bool:
    return not {"limit", "before"}.isdisjoint(request.query_params.keys())


def _leagues(registry: Registry, before: str | None, limit: int | None) -> dict[str, Any]:
    """At most `limit` leagues by name, after the cursor."""
    archived = registry.leagues.names()
    names = sorted(name for name in archived if before is None or name > before)
    page, more = parsing.paginate(names, len(names) if limit is None else limit, lambda name: name)
    aliases: dict[str, dict[str, int]] = {league: {} for league in page}
    for (league, alias), target in registry.aliases.all().items():
        if league in aliases:
            aliases[league][alias] = target.version
    versions, verdicts = registry.versions.numbers(), registry.verdicts.last_closed()
    summaries = registry.snapshots.of_part(SUMMARY)
    evaluations, runs = registry.evaluations.counts(), registry.runs.counts()
    counts = request_counts(registry.replicas.reports().values())

    def document(league: str, found: dict[str, int]) -> dict[str, Any]:
        summary = summaries[league].document if league in summaries else {}
        return {
            "league": league,
            "champion": found.get(CHAMPION),
            "aliases": found,
            "versions": len(versions.get(league, ())),
            "games": summary.get("games"),
            "matches": summary.get("matches"),
            "last_verdict": documents.verdict_summary(verdicts[league]) if league in verdicts else None,
            "running_evaluations": sum(evaluations.get(league, {}).values()),
            "running_runs": runs.get(league, 0),
            "archived_at": (at := archived[league]) and at.isoformat(),
        } | _requests(counts.get(league, NO_REQUESTS))

    return {"leagues": [document(league, league_aliases) for league, league_aliases in aliases.items()], "next": more}


def _league(registry: Registry, league: str) -> dict[str, Any]:
    row = registry.leagues.get(league)
    aliases = registry.aliases.current(league)
    mixtures = registry.versions.mixtures(league, set(aliases.values()))
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
            alias: documents.members_document(mixtures[number])
            for alias, number in aliases.items()
            if number in mixtures
        },
        "policies": {policy: interface.of_policy(policy).model_dump(mode="json") for policy in interface.policy_ids},
        "agents": interface.policies,
        "sides": interface.sides,
        "baselines": baselines(row.config, interface),
        "replicas": list(map(_replica, acknowledgements)),
        "faults": sorted({acknowledgement.fault for acknowledgement in acknowledgements if acknowledgement.fault}),
        "traffic": documents.traffic_document(registry.traffic.current(league)),
        "summary": summary and summary.document,
        "computed_at": summary and summary.at.isoformat(),
        "up_to_date": summary is not None and summary.mark == registry.snapshots.current_marks()[league],
    } | _requests(counts.get(league, NO_REQUESTS))


def _requests(counts: RequestCounts) -> dict[str, Any]:
    return {"requests": counts.count, "requests_per_second": counts.rate}


def _replica(acknowledgement: Acknowledgement) -> dict[str, Any]:
    return {
        "replica": acknowledgement.replica,
        "version": acknowledgement.version,
        "sha256": acknowledgement.sha256,
        "aliases": acknowledgement.aliases,
        "fault": acknowledgement.fault,
        "event": acknowledgement.event,
        "seen_at": acknowledgement.seen_at.isoformat(),
        "silent_seconds": max(0.0, acknowledgement.silence.total_seconds()),
    }


def _all_versions(registry: Registry, league: str) -> dict[str, Any]:
    return {"league": league, "versions": list(map(version_document, registry.versions.all(league))), "next": None}


def version_document(row: VersionRow) -> dict[str, Any]:
    """A version as JSON."""
    return {
        "version": row.number,
        "aliases": list(row.aliases),
        "sha256": row.sha256,
        "parent": row.parent,
        "role": row.role,
        "exploits": row.exploits,
        "members": row.mixture and documents.members_document(row.mixture),
        "steps": row.steps,
        "algorithm": row.manifest.algorithm,
        "policies": list(row.manifest.policies),
        "created_at": row.created_at.isoformat(),
        "retired_at": row.retired_at and row.retired_at.isoformat(),
        "note": row.note and {"text": row.note.text, "actor": row.note.actor, "at": row.note.at.isoformat()},
    }
