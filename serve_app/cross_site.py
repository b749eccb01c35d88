"""Requests that a page of another site has a browser send: they change nothing here, whatever they carry.

Keys go in headers, which such a page cannot set; but where no key is needed its requests would be as good as anybody's.
Browsers say where a request comes from, and no page can make them say otherwise: by `Sec-Fetch-Site` (W3C, "Fetch
Metadata Request Headers") where they know it, by `Origin` (RFC 6454) else. Programs send neither.
"""

from collections.abc import Iterable

from serve_app.error_handlers import CrossSite

READ = frozenset((b"sec-fetch-site", b"origin"))
"""Headers by which a browser tells."""
SAFE = ("GET", "HEAD")
OURS = (b"same-origin", b"none")
"""A page of this server, and a person: by a bookmark, or what was typed."""


def refuse_cross_site(method: str, headers: Iterable[tuple[bytes, bytes]]) -> None:
    """Raise CrossSite if a request that is not just for looking was made by a page that is not of this server."""
    if method in SAFE:
        return
    said = dict(headers)
    site, origin = said.get(b"sec-fetch-site"), said.get(b"origin")
    # A page at another port of the same machine is of the same site, but not ours.
    is_ours = site in OURS if site is not None else origin is None or _authority(origin) == said.get(b"host")
    if not is_ours:
        shown = (origin or b"another site").decode("latin-1")[:100]
        raise CrossSite(f"a page of {shown} made this request: only pages of this server may")


def _authority(origin: bytes) -> bytes:
    """Host and port; of `null`, which stands for a page without an origin, nothing that a host is called."""
    return origin.partition(b"://")[2]
