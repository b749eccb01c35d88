"""A server's address: builds HTTP requests and parses responses or errors, without I/O."""

import os
from functools import lru_cache
from typing import Any, TypeVar

import httpx

from policy_league_client.calls import ApiCall
from policy_league_client.errors import InvalidInput, RemoteError, one_line
from policy_league_client.loopback import is_loopback
from policy_league_client.proxies import through_proxy, usable_proxies
from policy_league_client.retries import Outcome, parse_error, parse_object

C = TypeVar("C", httpx.Client, httpx.AsyncClient)
T = TypeVar("T")

DEFAULT_URL = "http://127.0.0.1:8000"
"""The address on which `league serve` listens by default."""
KEY_VARIABLE = "LEAGUE_API_KEY"
"""Environment variable with the default API key."""
TIMEOUT_HEADER = "x-request-timeout-ms"
"""Tells the server when the client gives up."""
CALLER_HEADER = "x-league-key"
"""Identifies the caller: during a canary release, each caller is answered by one version."""
LIMITS = httpx.Limits(max_connections=1000, max_keepalive_connections=100, keepalive_expiry=30.0)
"""Limits of one client. The server keeps idle connections for longer, so that the client closes them first."""

_parse_url = lru_cache(maxsize=1024)(httpx.URL)  # a client requests few different URLs


class Endpoint:
    """A server's base URL with the API key, the caller and the timeout of one attempt."""

    def __init__(self, url: str, key: str | None, caller: str | None, timeout: float) -> None:
        """Raises InvalidInput if an argument is invalid."""
        if not timeout > 0:
            raise InvalidInput(f"timeout is {timeout:g} s, expected more than 0")
        try:
            base = httpx.URL(url.rstrip("/"))
        except httpx.InvalidURL:
            base = httpx.URL()
        if base.scheme not in ("http", "https") or not base.host:
            raise InvalidInput(f"{url!r} is not the address of a server: expected a URL such as http://127.0.0.1:8000")
        self.url = url.rstrip("/")
        key = os.environ.get(KEY_VARIABLE) if key is None else key
        self.headers = {TIMEOUT_HEADER: str(max(1, round(timeout * 1000)))}
        if key:
            self.headers["authorization"] = f"Bearer {_check_header('API key', key)}"
        if caller is not None:
            self.headers[CALLER_HEADER] = _check_header("caller", caller)
        self.timeout = timeout
        host = base.netloc.decode("ascii")
        # httpx would compute these for every request, which takes half of the client's time for it.
        self._headers = httpx.Headers({"host": host, "accept-encoding": "gzip", **self.headers})
        self._post_headers = httpx.Headers({**self._headers, "content-type": "application/json"})
        self.is_loopback = is_loopback(base.host)
        """Whether the server is on this machine, which no proxy reaches."""
        self._extensions = {"timeout": httpx.Timeout(timeout).as_dict()}

    def http_client(self, client: type[C]) -> C:
        """Create the HTTP client, `httpx.Client` or `httpx.AsyncClient`. Raises InvalidInput for an unusable proxy."""
        # Loading certificates takes time.
        verify = httpx.create_ssl_context() if self.url.startswith("https") else False
        with usable_proxies():
            return client(limits=LIMITS, verify=verify, trust_env=not self.is_loopback)

    @property
    def websocket_url(self) -> str:
        """The base URL for WebSocket connections."""
        return f"ws{self.url.removeprefix('http')}"

    def request(self, call: ApiCall[Any]) -> httpx.Request:
        """Build the request for one attempt."""
        headers = self._headers if call.body is None else self._post_headers
        if call.headers:
            headers = httpx.Headers({**headers, **call.headers})
        method = "DELETE" if call.is_delete else "GET" if call.body is None else "POST"
        url = _parse_url(self.url + call.path)
        return httpx.Request(method, url, headers=headers, content=call.body, extensions=self._extensions)

    def parse(self, call: ApiCall[T], outcome: Outcome) -> T:
        """Return the result of a call. Raises the LeagueError that corresponds to a failure."""
        url = self.url + call.path
        if not isinstance(outcome, httpx.Response):
            raise RemoteError(f"{url} cannot be reached{through_proxy(url)}: {one_line(outcome)}") from outcome
        body = parse_object(outcome.content)
        if outcome.status_code in (200, 202) and body is not None:
            return call.parse(body, outcome.headers.get("x-league-replica", ""))
        raise parse_error(outcome, url)


def _check_header(name: str, text: str) -> str:
    text = text.strip()
    if not (text.isascii() and text.isprintable()):
        raise InvalidInput(f"the {name} contains invalid characters: expected printable ASCII")
    return text
