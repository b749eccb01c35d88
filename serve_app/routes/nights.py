"""Lists nights of training and nightly runs: the champion after each, how exploitable it is, and the verdicts.

GET  /v1/leagues/{league}/nights         nights of training, newest first; ?limit= &before=
GET  /v1/leagues/{league}/nightly-runs   nightly runs, newest first; ?limit= &before=
"""

from collections.abc import Mapping
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.storage.rows import NightlyRunRow, TrainingNightRow
from serve_app.models.resolver import ModelResolver
from serve_app.routes import parsing

RATINGS = "ratings"
"""The snapshot with the ratings of all versions."""


class NightRoutes:
    """The endpoints."""

    def __init__(self, models: ModelResolver) -> None:
        self._models = models

    async def page(self, request: Request) -> Response:
        """A page of a league's nights of training. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = parsing.page_size(request), parsing.query_number(request, "before")

        def query(registry: Registry) -> dict[str, Any]:
            rows = [row for row in reversed(registry.training_nights.all(league)) if before is None or row.id < before]
            page, more = parsing.paginate(rows[: limit + 1], limit, lambda row: row.id)
            snapshot = registry.snapshots.get(league, RATINGS)
            ratings = {} if snapshot is None else {rating["ref"]: rating for rating in snapshot.document["versions"]}
            return {"league": league, "nights": [_night(row, ratings) for row in page], "next": more}

        return await parsing.query_response(self._models, query)

    async def nightly_runs(self, request: Request) -> Response:
        """A page of a league's nightly runs. Raises UnknownLeague or InvalidInput."""
        league = check_slug("league", request.path_params["league"])
        limit, before = parsing.page_size(request), parsing.query_number(request, "before")

        def query(registry: Registry) -> dict[str, Any]:
            rows = [row for row in reversed(registry.nightly_runs.all(league)) if before is None or row.id < before]
            page, more = parsing.paginate(rows[: limit + 1], limit, lambda row: row.id)
            return {"league": league, "nightly_runs": list(map(_nightly_run, page)), "next": more}

        return await parsing.query_response(self._models, query)


def _nightly_run(row: NightlyRunRow) -> dict[str, Any]:
    """A nightly run as JSON. What it decided is null or empty while it runs."""
    report = row.report or {}
    fields = ("verdict", "candidate", "opponent", "outcome", "promoted")
    return {
        "nightly_run": row.id,
        "candidates": [f"{row.league}@{number}" for number in row.candidates],
        "alpha": row.alpha,
        "verdicts": [{name: verdict[name] for name in fields} for verdict in report.get("verdicts", ())],
        "champion_before": report.get("champion_before"),
        "champion": report.get("champion"),
        "errors": report.get("faults", []),
        "began_at": row.began_at.isoformat(),
        "ended_at": row.ended_at and row.ended_at.isoformat(),
    }


def _night(row: TrainingNightRow, ratings: Mapping[str, Any]) -> dict[str, Any]:
    """A night as JSON. Results of steps that are not complete yet are null or empty."""
    train, gate, measured = (row.steps.get(step, {}) for step in ("train", "gate", "measure"))
    champion = gate.get("champion")
    rated = ratings.get(champion, {})
    return {
        "night": row.id,
        "number": row.number,
        "run": row.run,
        "exploiter_run": row.steps.get("exploiter", {}).get("run"),
        "parent": row.start,
        "versions": train.get("versions", []),
        "champion_before": gate.get("champion_before"),
        "champion": champion,
        "rating": rated.get("rating"),
        "interval": rated.get("interval"),
        "exploitability": _exploitability(measured.get("exploitability")),
        "errors": [f"{step}: {result['error']}" for step, result in row.steps.items() if "error" in result],
        "began_at": row.began_at.isoformat(),
        "ended_at": row.ended_at and row.ended_at.isoformat(),
    }


def _exploitability(measured: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The score of the best exploiter against the champion, and the lower bound of a best response's score."""
    if measured is None:
        return None
    best = measured["exploiters"][0]
    return {"bound": measured["bound"], "exploiter": best["ref"]} | {
        name: best[name] for name in ("games", "score", "low", "high", "gain")
    }
