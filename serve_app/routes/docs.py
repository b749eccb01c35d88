"""GET /openapi.json and /docs: what the server answers to, for programs and for people.

Both are open, as health is. The examples of policies tell which leagues there are, so a stranger gets none of them.
"""

import asyncio
from base64 import b64encode
from hashlib import sha256
from pathlib import Path
from re import DOTALL, findall

import orjson
from starlette.requests import Request
from starlette.responses import Response

from serve_app import openapi
from serve_app.doors import Doors
from serve_app.live import Live
from serve_app.loading import LoadedVersion
from serve_app.openapi.document import document
from serve_app.settings import ServeSettings

PAGE = Path(openapi.__file__).with_name("page.html")
FRESH = {"cache-control": "no-cache", "vary": "authorization, x-api-key"}


class DocsRoutes:
    """The endpoints."""

    def __init__(self, live: Live, doors: Doors, settings: ServeSettings) -> None:
        self._live = live
        self._doors = doors
        self._settings = settings
        self._page = PAGE.read_bytes()
        self._rules = {"content-security-policy": _policy(self._page), "cache-control": "no-cache"}
        self._described: dict[tuple[str, ...], bytes] = {}
        """Digests of what is served → the description with examples of it: the last one, and the one without."""

    async def openapi(self, request: Request) -> Response:
        """An OpenAPI 3.1 document."""
        served: list[LoadedVersion] = []
        if self._doors.lets_read_all(request.scope["headers"]):
            champions = (self._live.champion(league) for league in self._live.leagues())
            served = [version for version in champions if version is not None]
        digests = tuple(version.sha256 for version in served)
        if (body := self._described.get(digests)) is None:
            body = await asyncio.to_thread(lambda: orjson.dumps(document(self._settings, served)))
            without = {key: kept for key, kept in self._described.items() if not key}
            self._described = without | {digests: body}
        return Response(body, media_type="application/json", headers=FRESH)

    async def docs(self, _: Request) -> Response:
        """A page that shows the document and sends requests to this server. It loads nothing from elsewhere."""
        return Response(self._page, media_type="text/html", headers=self._rules)


def _policy(page: bytes) -> str:
    """A Content-Security-Policy by which the page runs its own script alone, and talks to its own server alone."""
    scripts = [b64encode(sha256(code).digest()).decode() for code in findall(rb"<script>(.*?)</script>", page, DOTALL)]
    allowed = " ".join(f"'sha256-{digest}'" for digest in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; connect-src 'self'; img-src data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
