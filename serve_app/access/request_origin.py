"""Refuses requests that pages of other sites send through a browser.

A page of another site cannot set the headers that carry an API key, but it could call a server that requires no key.

- Browsers state the origin of a request in `Sec-Fetch-Site` (W3C, "Fetch Metadata Request Headers") or `Origin` (RFC
  6454), and a page cannot change these headers.
- With DNS rebinding a page is of the same origin as the server: its host name first resolves to the server of the page,
  then to 127.0.0.1. The `Host` header still has the name, and a page cannot change it either.
"""

from collections.abc import Collection, Iterable
from functools import lru_cache

from policy_league_client.loopback import is_loopback
from serve_app.access.errors import CrossSiteRequest, UntrustedHost

ORIGIN_HEADERS = frozenset((b"sec-fetch-site", b"origin"))
"""Headers in which a browser states the origin of a request."""
SAFE_METHODS = ("GET", "HEAD")
"""Methods whose responses browsers hide from pages of other origins. They do not hide a WebSocket, whose handshake is a
GET."""
SAME_ORIGIN = (b"same-origin", b"none")
"""Values of `Sec-Fetch-Site` for a page of this server, and for a bookmark or a typed address."""
MAX_AUTHORITY = 262
"""Length of the longest host name (RFC 1035) with a port."""


def reject_cross_site(
    kind: str, method: str, headers: Iterable[tuple[bytes, bytes]], trusted: Collection[str] = ()
) -> None:
    """Raise CrossSiteRequest if a page of another origin sent a request that is not GET or HEAD, or opens a WebSocket.

    kind: The ASGI scope type. trusted: Origins whose pages may do so.
    """
    if kind == "http" and method in SAFE_METHODS:
        return
    values = dict(headers)
    site, origin = values.get(b"sec-fetch-site"), values.get(b"origin")
    if origin is not None and origin.decode("latin-1") in trusted:
        return
    # "same-site" is not enough: it includes pages on other ports of this machine.
    if site is not None:
        is_ours = site in SAME_ORIGIN
    else:  # the opaque origin, `null`, has no host
        is_ours = origin is None or origin.partition(b"://")[2] == values.get(b"host")
    if not is_ours:
        sender = (origin or b"another origin").decode("latin-1")[:100]
        raise CrossSiteRequest(f"cross-site request from {sender} refused: only pages of this server may send it")


def reject_foreign_host(headers: Iterable[tuple[bytes, bytes]]) -> None:
    """Raise UntrustedHost if a `Host` header does not name the loopback interface. Browsers always send one."""
    for name, value in headers:
        if name == b"host" and not (len(value) <= MAX_AUTHORITY and _is_loopback(value)):
            host = value.decode("latin-1")[:100]
            raise UntrustedHost(
                f"a server without API keys accepts only requests to localhost, not to {host}: "
                "create a key (league keys create), or set require_keys to never"
            )


@lru_cache(maxsize=64)
def _is_loopback(authority: bytes) -> bool:
    host = authority.decode("latin-1").lower()
    host = host[1 : host.find("]")] if host.startswith("[") else host.partition(":")[0]
    return is_loopback(host)
