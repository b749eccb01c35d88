"""Whether this replica lives, and whether it is loaded."""

from starlette.requests import Request
from starlette.responses import JSONResponse

from league.errors import NotReady
from serve_app.alias_watcher import AliasWatcher


class HealthRoutes:
    """GET /v1/health/live and /v1/health/ready."""

    def __init__(self, watcher: AliasWatcher, replica: str) -> None:
        self._watcher = watcher
        self._replica = replica

    async def live(self, _: Request) -> JSONResponse:
        """200 as long as the process answers."""
        return JSONResponse({"status": "live", "replica": self._replica})

    async def ready(self, _: Request) -> JSONResponse:
        """200 once everything that the registry's aliases name is loaded, as far as it can be. Raises NotReady."""
        if not self._watcher.is_ready:
            raise NotReady(f"replica {self._replica} does not follow the registry's aliases yet")
        return JSONResponse({"status": "ready", "replica": self._replica})
