"""What there is to ask for: leagues, their versions, and which replica serves what.

GET  /v1/leagues                      by name, all of them; with ?limit= or &before= a page
GET  /v1/leagues/{league}
GET  /v1/leagues/{league}/versions    ascending, all of them; with ?limit= or &before= a page, newest first
"""

from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.refs import CHAMPION, check_slug
from league.registry.registry import Registry
from league.registry.rows import Acknowledgement, VersionRow
from league.registry.snapshots import SUMMARY
from serve_app import queries
from serve_app.lookups import looked_up
from serve_app.models import Models
from serve_app.request_rates import Requests, requests
from serve_app.routes.traffic import setting_document
from serve_app.routes.verdicts import brief
from serve_app.settings import ACKNOWLEDGED_WITHIN

NONE_YET = Requests()


class LeagueRoutes:
    """GET /v1/leagues and below."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def leagues(self, request: Request) -> Response:
        """Leagues: their champions, and what goes on in each. Raises InvalidInput."""
        limit = queries.limit(request) if _is_paged(request) else None
        before = queries.name(request, "before")
        return await looked_up(self._models, lambda registry: _leagues(registry, before, limit))

    async def league(self, request: Request) -> Response:
        """One league: aliases, policies, and what each replica serves. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])
        return await looked_up(self._models, lambda registry: _league(registry, league))

    async def versions(self, request: Request) -> Response:
        """The versions of a league. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        if not _is_paged(request):
            return await looked_up(self._models, lambda registry: _all_versions(registry, league))
        limit, before = queries.limit(request), queries.number(request, "before")

        def question(registry: Registry) -> dict[str, Any]:
            rows = registry.newest_versions(league, before=before, limit=limit + 1)
            page, more = queries.paged(rows, limit, lambda row: row.number)
            return {"league": league, "versions": list(map(version_document, page)), "next": more}

        return await looked_up(self._models, question)


def _is_paged(request: Request) -> bool:
    return not {"limit", "before"}.isdisjoint(request.query_params.keys())


def _leagues(registry: Registry, before: str | None, limit: int | None) -> dict[str, Any]:
    """By name, at most `limit` of those behind the one that ended the page before."""
    names = sorted(row.slug for row in registry.leagues() if before is None or row.slug > before)
    page, more = queries.paged(names, len(names) if limit is None else limit, lambda name: name)
    aliases: dict[str, dict[str, int]] = {league: {} for league in page}
    for (league, alias), number in registry.all_aliases().items():
        if league in aliases:
            aliases[league][alias] = number
    versions, verdicts, summaries = registry.version_numbers(), registry.last_verdicts(), registry.snapshots(SUMMARY)
    evaluations, runs = registry.evaluation_counts(), registry.run_counts()
    asked = requests(registry.reports(since=ACKNOWLEDGED_WITHIN).values())

    def document(league: str, found: dict[str, int]) -> dict[str, Any]:
        summary = summaries[league].document if league in summaries else {}
        return {
            "league": league,
            "champion": found.get(CHAMPION),
            "aliases": found,
            "versions": len(versions.get(league, ())),
            "games": summary.get("games"),
            "matches": summary.get("matches"),
            "last_verdict": brief(verdicts[league]) if league in verdicts else None,
            "running_evaluations": sum(evaluations.get(league, {}).values()),
            "running_runs": runs.get(league, 0),
        } | _asked(asked.get(league, NONE_YET))

    return {"leagues": [document(league, found) for league, found in aliases.items()], "next": more}


def _league(registry: Registry, league: str) -> dict[str, Any]:
    row = registry.league(league)
    aliases = registry.aliases(league)
    said = registry.acknowledgements(league, since=ACKNOWLEDGED_WITHIN)
    asked = requests(registry.reports(since=ACKNOWLEDGED_WITHIN).values())
    summary = registry.snapshot(league, SUMMARY)
    interface = row.interface
    return {
        "league": league,
        "environment": row.config.environment.entry_point,
        "champion": aliases.get(CHAMPION),
        "aliases": aliases,
        "policies": {policy: interface.of_policy(policy).model_dump(mode="json") for policy in interface.policy_ids},
        "agents": interface.policies,
        "replicas": [_replica(acknowledgement) for acknowledgement in said],
        "faults": sorted({acknowledgement.fault for acknowledgement in said if acknowledgement.fault}),
        "traffic": setting_document(registry.traffic(league)),
        "summary": summary and summary.document,
        "computed_at": summary and summary.at.isoformat(),
        "up_to_date": summary is not None and summary.mark == registry.marks()[league],
    } | _asked(asked.get(league, NONE_YET))


def _asked(asked: Requests) -> dict[str, Any]:
    return {"requests": asked.count, "requests_per_second": asked.rate}


def _replica(said: Acknowledgement) -> dict[str, Any]:
    return {
        "replica": said.replica,
        "version": said.version,
        "sha256": said.sha256,
        "aliases": said.aliases,
        "fault": said.fault,
        "seen_at": said.seen_at.isoformat(),
    }


def _all_versions(registry: Registry, league: str) -> dict[str, Any]:
    return {"league": league, "versions": list(map(version_document, registry.versions(league))), "next": None}


def version_document(row: VersionRow) -> dict[str, Any]:
    """A version as JSON."""
    return {
        "version": row.number,
        "aliases": list(row.aliases),
        "sha256": row.sha256,
        "parent": row.parent,
        "steps": row.steps,
        "algorithm": row.manifest.algorithm,
        "policies": list(row.manifest.policies),
        "created_at": row.created_at.isoformat(),
        "note": row.note and {"text": row.note.text, "actor": row.note.actor, "at": row.note.at.isoformat()},
    }
