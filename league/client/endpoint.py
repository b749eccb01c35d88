"""Where a server is, how it is asked, and what its answers mean. Holds no connection."""

import os
from functools import lru_cache
from typing import Any, TypeVar

import httpx

from league.client.calls import Call
from league.client.faults import fault
from league.client.patience import Outcome, told
from league.errors import InvalidInput, RemoteError

T = TypeVar("T")

URL = "http://127.0.0.1:8000"
"""Where `league serve` listens by default."""
API_KEY = "LEAGUE_API_KEY"
"""The environment variable that holds the key of those who give none."""
LIMIT = "x-request-timeout-ms"
"""The header by which a server gives up when its client does."""
CALLER = "x-league-key"
"""The header that says what stays with one version while a canary is tried."""
LIMITS = httpx.Limits(max_connections=1000, max_keepalive_connections=100, keepalive_expiry=30.0)
"""Of one client; the server keeps a connection for longer, so that it is not the one to hang up."""


class Endpoint:
    """A server's address, the key that is shown to it, and how long an attempt may take."""

    def __init__(self, url: str, key: str | None, caller: str | None, timeout: float) -> None:
        """Raises InvalidInput if `url` is no address, `key` or `caller` no header, or the timeout not positive."""
        if not timeout > 0:
            raise InvalidInput(f"timeout is {timeout:g} s, expected more than 0")
        self.url = _checked(url)
        key = os.environ.get(API_KEY) if key is None else key
        self.headers = {LIMIT: str(max(1, round(timeout * 1000)))}
        if key:
            self.headers["authorization"] = f"Bearer {_printable('API key', key)}"
        if caller is not None:
            self.headers[CALLER] = _printable("caller", caller)
        self.timeout = timeout
        base = httpx.URL(self.url)
        host = base.netloc.decode("ascii")
        # What httpx would work out for every request, once: it is half of what a request costs the client.
        self._headers = httpx.Headers({"host": host, "accept-encoding": "gzip", **self.headers})
        self._post_headers = httpx.Headers({**self._headers, "content-type": "application/json"})
        self.is_encrypted = base.scheme == "https"
        """Whether certificates, which take a while to load, are looked at."""
        self._extensions = {"timeout": httpx.Timeout(timeout).as_dict()}

    @property
    def websocket_url(self) -> str:
        """The same server, for a WebSocket."""
        return f"ws{self.url.removeprefix('http')}"

    def request(self, call: Call[Any]) -> httpx.Request:
        """The request of one attempt."""
        headers = self._headers if call.body is None else self._post_headers
        if call.headers:
            headers = httpx.Headers({**headers, **call.headers})
        method = "DELETE" if call.is_removal else "GET" if call.body is None else "POST"
        url = _url(self.url + call.path)
        return httpx.Request(method, url, headers=headers, content=call.body, extensions=self._extensions)

    def read(self, call: Call[T], outcome: Outcome) -> T:
        """What the caller gets. Raises the LeagueError that the outcome stands for."""
        where = self.url + call.path
        if not isinstance(outcome, httpx.Response):
            raise RemoteError(f"{where} cannot be reached: {str(outcome) or type(outcome).__name__}") from outcome
        document = told(outcome)
        if outcome.status_code in (200, 202) and document is not None:
            return call.read(document, outcome.headers.get("x-league-replica", ""))
        raise fault(outcome, where)


def _checked(url: str) -> str:
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL:
        parsed = httpx.URL()
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise InvalidInput(f"{url!r} is no address of a server: expected something like http://127.0.0.1:8000")
    return url.rstrip("/")


def _printable(what: str, text: str) -> str:
    text = text.strip()
    if not (text.isascii() and text.isprintable()):
        raise InvalidInput(f"the {what} holds characters that no {what} has: expected printable ASCII")
    return text


@lru_cache(maxsize=1024)  # the same few come with every call
def _url(text: str) -> httpx.URL:
    return httpx.URL(text)
