"""GET /metrics: all replicas, for Prometheus, whichever of them is asked."""

from prometheus_client import CONTENT_TYPE_LATEST
from starlette.requests import Request
from starlette.responses import Response

from league.registry.registry import Registry
from serve_app.exposition import text
from serve_app.metrics import Report
from serve_app.models import Models
from serve_app.settings import ACKNOWLEDGED_WITHIN

NOBODY = ""
"""The replica of what is true of all: to Prometheus a label that is empty is none."""


class MetricsRoute:
    """Replicas stand behind one address, so whoever is asked answers for all, from what each wrote last.

    It answers for itself, too, from what it wrote: a counter must not be seen to fall when another is asked next.
    """

    def __init__(self, models: Models) -> None:
        self._models = models

    async def metrics(self, _: Request) -> Response:
        """Prometheus's text format. Raises StorageError."""
        return Response(await self._models.ask(_metrics), media_type=CONTENT_TYPE_LATEST)


def _metrics(registry: Registry) -> bytes:
    return text(registry.reports(since=ACKNOWLEDGED_WITHIN) | {NOBODY: _of_all(registry)})


def _of_all(registry: Registry) -> Report:
    counts = registry.evaluation_counts()
    samples = [[[league, state], count] for league, states in counts.items() for state, count in states.items()]
    return {"league_evaluations": samples}
