"""GET /v1/key: what the key may do that a request shows, so that a program or a page offers nothing that is refused."""

from starlette.requests import Request
from starlette.responses import JSONResponse

from serve_app.doors import Doors


class KeyRoute:
    """The endpoint. It is open: without a key it tells whether one is needed."""

    def __init__(self, doors: Doors) -> None:
        self._doors = doors

    async def key(self, request: Request) -> JSONResponse:
        """The key's name, scopes and leagues, null for all. Raises Unauthenticated for a key that is none."""
        key = self._doors.key_of(request.scope["headers"])
        shown = key and {
            "name": key.name,
            "scopes": sorted(key.scopes),
            "leagues": None if key.leagues is None else sorted(key.leagues),
        }
        headers = {"cache-control": "no-store"}
        return JSONResponse({"key": shown, "is_needed": self._doors.are_locked}, headers=headers)
