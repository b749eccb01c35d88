"""Serves the web pages, the OpenAPI document and its page.

None of them requires a key. The OpenAPI document contains examples of policies only if the presented key may read all
leagues. Pages load nothing from other origins, run only their own scripts, and cannot be framed. Browsers revalidate
their copies by ETag. All references are relative, so that the pages work below any prefix that a proxy adds to paths.
"""

from __future__ import annotations

import asyncio
import gzip
import re
from base64 import b64encode
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import orjson
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

import serve_app
from serve_app.access.access_control import AccessControl
from serve_app.declaration import Declaration
from serve_app.live_versions.alias_slots import AliasSlots
from serve_app.live_versions.policies import LoadedVersion

PAGE = Path(serve_app.__file__).parent / "openapi" / "page.html"
FRESH = {"cache-control": "no-cache", "vary": "authorization, x-api-key"}


class DocsRoutes:
    """The OpenAPI document and its page. document: returns it with examples for the served versions."""

    def __init__(
        self, slots: AliasSlots, access: AccessControl, document: Callable[[list[LoadedVersion]], dict[str, Any]]
    ) -> None:
        self._slots = slots
        self._access = access
        self._document = document
        self._page = PAGE.read_bytes()
        codes = re.findall(rb"<script>(.*?)</script>", self._page, re.DOTALL)
        scripts = " ".join(f"'sha256-{b64encode(sha256(code).digest()).decode()}'" for code in codes)
        # Only the page's own script, and requests to its own server.
        policy = (
            f"default-src 'none'; script-src {scripts}; style-src 'unsafe-inline'; connect-src 'self'; img-src data:; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        self._rules = {"content-security-policy": policy, "cache-control": "no-cache"}
        self._described: dict[tuple[str, ...], bytes] = {}
        """Digests of the served versions → the document: the latest, and the one without examples."""

    @Declaration("GET", "/openapi.json", "OpenApi", scope=None, tag="Server", success="An OpenAPI 3.1 document.")
    async def openapi(self, request: Request) -> Response:
        """Get this description.

        If no key is required, or with a key that has the scope `read` for all leagues, it includes examples for all
        served policies.
        """
        served: list[LoadedVersion] = []
        if self._access.may_read_all(request.scope["headers"]):
            champions = (self._slots.champion(league) for league in self._slots.leagues())
            served = [version for version in champions if version is not None]
        digests = tuple(version.sha256 for version in served)
        if (body := self._described.get(digests)) is None:
            body = await asyncio.to_thread(lambda: orjson.dumps(self._document(served)))
            without = {key: kept for key, kept in self._described.items() if not key}
            self._described = without | {digests: body}
        return Response(body, media_type="application/json", headers=FRESH)

    @Declaration("GET", "/docs", scope=None, tag="Server", success="A self-contained HTML page.", media=("text/html",))
    async def docs(self, _: Request) -> Response:
        """Get this description as a web page.

        The page also sends requests to this server.
        """
        return Response(self._page, media_type="text/html", headers=self._rules)


FILES = Path(serve_app.__file__).with_name("pages")
DOCUMENT = "index.html"
MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
"""Served files; others, such as licences, are not served."""
HEADERS = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",
    "vary": "accept-encoding",
}
MAX_DEPTH = 8
"""Slashes after the first one in the path of a page."""
MIN_COMPRESSED_BYTES = 1024
"""Smaller files are not compressed."""


@dataclass(frozen=True, slots=True)
class StaticFile:
    """A file with its compressed form."""

    plain: bytes
    zipped: bytes | None
    media_type: str
    etag: str

    @classmethod
    @cache
    def of(cls, path: Path, plain: bytes) -> StaticFile:
        """Compress the content of a file, unless this process has done so before."""
        zipped = gzip.compress(plain, mtime=0) if len(plain) >= MIN_COMPRESSED_BYTES else None
        return cls(plain, zipped, MEDIA_TYPES[path.suffix], f'W/"{sha256(plain).hexdigest()[:24]}"')

    def response(self, request: Request) -> Response:
        """The file, or 304 if the browser's copy is current."""
        headers = HEADERS | {"etag": self.etag}
        if self.etag in (tag.strip() for tag in request.headers.get("if-none-match", "").split(",")):
            return Response(status_code=304, headers=headers)
        if self.zipped is not None and "gzip" in request.headers.get("accept-encoding", ""):
            return Response(self.zipped, media_type=self.media_type, headers=headers | {"content-encoding": "gzip"})
        return Response(self.plain, media_type=self.media_type, headers=headers)


class PageRoutes:
    """The web pages. All files are read at start-up; they are few and small."""

    def __init__(self) -> None:
        paths = (path for path in FILES.rglob("*") if path.suffix in MEDIA_TYPES)
        self._files = {path.relative_to(FILES).as_posix(): StaticFile.of(path, path.read_bytes()) for path in paths}
        self._documents = [StaticFile.of(FILES / DOCUMENT, _document(depth)) for depth in range(MAX_DEPTH + 1)]

    @Declaration("GET", "/", scope=None, tag=None)
    @Declaration("GET", "/leagues", scope=None, tag=None)
    @Declaration("GET", "/leagues/{page:path}", scope=None, tag=None)
    async def document(self, request: Request, page: str = "") -> Response:  # noqa: ARG002
        """The HTML document, which differs by the depth of the path only: its script renders what the address names."""
        depth = request.scope["raw_path"].count(b"/") - 1  # as the browser counts: an encoded slash does not separate
        if depth > MAX_DEPTH:
            raise HTTPException(404)
        return self._documents[depth].response(request)

    @Declaration("GET", "/pages/{file:path}", scope=None, tag=None)
    async def file(self, request: Request, file: str) -> Response:
        """A static file."""
        static_file = self._files.get(file)
        if static_file is None:
            raise HTTPException(404)
        return static_file.response(request)


def _document(depth: int) -> bytes:
    """The document for paths with this number of slashes after the first one. Its references start with a slash."""
    return re.sub(rb'(href|src)="/', rb'\1="' + (b"../" * depth or b"./"), (FILES / DOCUMENT).read_bytes())
