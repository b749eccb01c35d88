"""What there is to ask for: leagues, their versions, and which replica serves what."""

from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse

from league.refs import CHAMPION, check_slug
from league.registry.registry import Registry
from league.registry.rows import Acknowledgement, VersionRow
from serve_app.models import Models
from serve_app.settings import ACKNOWLEDGED_WITHIN


class LeagueRoutes:
    """GET /v1/leagues and below."""

    def __init__(self, models: Models) -> None:
        self._models = models

    async def leagues(self, _: Request) -> JSONResponse:
        """All leagues with their aliases."""
        return JSONResponse(await self._models.ask(_leagues))

    async def league(self, request: Request) -> JSONResponse:
        """One league: aliases, policies, and what each replica serves. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])
        return JSONResponse(await self._models.ask(lambda registry: _league(registry, league)))

    async def versions(self, request: Request) -> JSONResponse:
        """The versions of a league, ascending. Raises UnknownLeague."""
        league = check_slug("league", request.path_params["league"])
        rows = await self._models.ask(lambda registry: registry.versions(league))
        return JSONResponse({"league": league, "versions": [_version(row) for row in rows]})


def _leagues(registry: Registry) -> dict[str, Any]:
    aliases: dict[str, dict[str, int]] = {row.slug: {} for row in registry.leagues()}
    for (league, alias), number in registry.all_aliases().items():
        aliases.setdefault(league, {})[alias] = number
    return {
        "leagues": [
            {"league": league, "champion": found.get(CHAMPION), "aliases": found} for league, found in aliases.items()
        ]
    }


def _league(registry: Registry, league: str) -> dict[str, Any]:
    row = registry.league(league)
    aliases = registry.aliases(league)
    said = registry.acknowledgements(league, since=ACKNOWLEDGED_WITHIN)
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
    }


def _replica(said: Acknowledgement) -> dict[str, Any]:
    return {
        "replica": said.replica,
        "version": said.version,
        "sha256": said.sha256,
        "aliases": said.aliases,
        "fault": said.fault,
        "seen_at": said.seen_at.isoformat(),
    }


def _version(row: VersionRow) -> dict[str, Any]:
    return {
        "version": row.number,
        "aliases": list(row.aliases),
        "sha256": row.sha256,
        "parent": row.parent,
        "steps": row.steps,
        "algorithm": row.manifest.algorithm,
        "policies": list(row.manifest.policies),
        "created_at": row.created_at.isoformat(),
    }
