"""The league in the browser: one application of static files, which reads the same JSON as programs do.

GET /, /leagues, /leagues/…    the document; which page it is, its script sees from the address
GET /pages/{file}              scripts, styles and what they need

Open, as the description is: nothing of a league is in them. They load nothing from elsewhere, run no script but their
own, and cannot be framed. A browser asks whether its copy is still the one, by its digest.
"""

from __future__ import annotations

import gzip
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

import serve_app

FILES = Path(serve_app.__file__).with_name("pages")
DOCUMENT = "index.html"
MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
"""Of the files that are served; the others beside them (licences) are for people."""
RULES = {
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",
    "vary": "accept-encoding",
}
SMALLEST = 1024
"""Bytes below which compression saves nothing."""


@dataclass(frozen=True, slots=True)
class File:
    """A file as it is sent."""

    plain: bytes
    zipped: bytes | None
    media_type: str
    etag: str

    @classmethod
    def read(cls, path: Path) -> File:
        """Read it, and compress it once."""
        plain = path.read_bytes()
        zipped = gzip.compress(plain, mtime=0) if len(plain) >= SMALLEST else None
        return cls(plain, zipped, MEDIA_TYPES[path.suffix], f'W/"{sha256(plain).hexdigest()[:24]}"')

    def answer(self, request: Request) -> Response:
        """The file, or that the browser's copy is the same."""
        headers = RULES | {"etag": self.etag}
        if self.etag in (tag.strip() for tag in request.headers.get("if-none-match", "").split(",")):
            return Response(status_code=304, headers=headers)
        if self.zipped is not None and "gzip" in request.headers.get("accept-encoding", ""):
            return Response(self.zipped, media_type=self.media_type, headers=headers | {"content-encoding": "gzip"})
        return Response(self.plain, media_type=self.media_type, headers=headers)


class PageRoutes:
    """The endpoints. All files are read at the start: they are few and small."""

    def __init__(self) -> None:
        paths = (path for path in FILES.rglob("*") if path.suffix in MEDIA_TYPES)
        self._files = {path.relative_to(FILES).as_posix(): File.read(path) for path in paths}

    def routes(self) -> list[Route]:
        """Where they stand. They are no part of the API."""
        document = [(path, self.document) for path in ("/", "/leagues", "/leagues/{page:path}")]
        places = [*document, ("/pages/{file:path}", self.file)]
        return [Route(path, endpoint, include_in_schema=False) for path, endpoint in places]

    async def document(self, request: Request) -> Response:
        """The same for every page: its script shows what the address names, or that there is no such thing."""
        return self._files[DOCUMENT].answer(request)

    async def file(self, request: Request) -> Response:
        """One of the files."""
        found = self._files.get(request.path_params["file"])
        if found is None:
            raise HTTPException(404)
        return found.answer(request)
