"""The doors of a replica: every request, over HTTP, a WebSocket or gRPC, passes here before anything of ours sees it.

    origin → key → rate → backlog → deadline → the application
    403      401   429    429       504
             403

Behind HAProxy a replica still has ports of its own, which whoever reaches them may call: so the check is in the
replica. A deadline is for HTTP alone: gRPC has one of its own, and a stream, of events too, lasts.
"""

from collections.abc import Awaitable, Iterable
from typing import Any, NamedTuple

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from league.errors import DeadlineExceeded, Forbidden, InvalidInput, LeagueError, RateLimited, Unauthenticated
from serve_app import cross_site, permissions
from serve_app.access_log import LINE, AccessLog
from serve_app.backlog import Backlog
from serve_app.bodies import IS_READ
from serve_app.deadlines import Expired, within
from serve_app.error_handlers import BodyTooSlow, ErrorHandlers
from serve_app.keyring import Key, Keyring
from serve_app.middleware import lasts
from serve_app.permissions import Need
from serve_app.settings import ServeSettings

KEY = "league.key"
"""In the scope of a request that showed a key: that `Key`."""
BEARER = b"bearer "
READ_HERE = cross_site.READ | {b"authorization", b"x-api-key", b"x-request-timeout-ms"}
DENIAL = "websocket.http.response"
"""ASGI's extension by which a WebSocket that is refused learns why."""
POLICY_VIOLATION = 1008
UNKNOWN = "this API key is unknown, revoked or expired"


class Doors:
    """Who may pass, and how many at once. `is_exposed`: whether other machines reach this server."""

    def __init__(self, keyring: Keyring, settings: ServeSettings, is_exposed: bool) -> None:
        self._keyring = keyring
        self._settings = settings
        self._is_exposed = is_exposed
        self.backlog = Backlog(settings.max_waiting, settings.max_turn, settings.patience)

    @property
    def are_locked(self) -> bool:
        """Whether a request needs a key."""
        if self._settings.require_keys == "auto":
            return self._is_exposed or not self._keyring.is_empty
        return self._settings.require_keys == "always"

    def admit(self, need: Need, token: bytes | None) -> Key | None:
        """Let a request or a call pass; returns its key.

        Raises Unauthenticated, Forbidden, RateLimited or Overloaded.
        """
        key = None
        if need.scope is not None and (need.is_change or self.are_locked):
            key = self._authorize(need, token)
        if need.scope == "act":
            self.backlog.admit()
        return key

    def admit_message(self, key: Key | None) -> None:
        """Let a message of a stream pass, whose handshake showed `key`.

        Raises Unauthenticated (also if the key is valid no longer), RateLimited or Overloaded.
        """
        self.admit_still(key)
        if key is not None:
            _take(key)
        self.backlog.admit()

    def admit_still(self, key: Key | None) -> None:
        """Let a stream go on that was opened with `key`. Raises Unauthenticated if that is valid no longer."""
        if key is None:
            if self.are_locked:
                raise Unauthenticated("this stream needs an API key by now")
        elif not self._keyring.holds(key):
            raise Unauthenticated(f"the API key {key.name} was revoked, or has expired")

    def key_of(self, headers: Iterable[tuple[bytes, bytes]]) -> Key | None:
        """The key that a request shows, None without. Raises Unauthenticated if it is none, or valid no longer."""
        token = _shown(headers).token
        key = None if token is None else self._keyring.find(token)
        if token is not None and key is None:
            raise Unauthenticated(UNKNOWN)
        return key

    def lets_read_all(self, headers: Iterable[tuple[bytes, bytes]]) -> bool:
        """Whether a request that needs no key may be told of all leagues, by the key that it shows."""
        try:
            self.admit(Need("read", None, is_of_all=True), _shown(headers).token)
        except LeagueError:
            return False
        return True

    def admit_rpc(self, metadata: Iterable[tuple[str, Any]] | None, rpc: str, model: str) -> None:
        """Let a call of gRPC's GRPCInferenceService pass. Raises what `admit` raises."""
        self.admit(permissions.of_rpc(rpc, model), _shown(headers_of(metadata)).token)

    def _authorize(self, need: Need, token: bytes | None) -> Key:
        key = None if token is None else self._keyring.find(token)
        if key is None:
            raise Unauthenticated(self._why_not(need, token))
        if need.scope not in key.scopes:
            allowed = ", ".join(sorted(key.scopes))
            raise Forbidden(f"this needs a key of scope {need.scope}: {key.name} is for {allowed}")
        if key.leagues is not None and need.league not in key.leagues and (need.league or need.is_of_all):
            allowed, what = ", ".join(sorted(key.leagues)), "all leagues" if need.is_of_all else "another league"
            raise Forbidden(f"this is about {what}: {key.name} is for {allowed}")
        _take(key)
        return key

    def _why_not(self, need: Need, token: bytes | None) -> str:
        if self._keyring.is_empty:
            return f"this needs an API key, and there is none yet: league keys create NAME --scope {need.scope}"
        if token is None:
            return "this needs an API key: Authorization: Bearer plk_…"
        return UNKNOWN


class Guarded:
    """The ASGI application behind the doors."""

    def __init__(
        self,
        application: ASGIApp,
        doors: Doors,
        errors: ErrorHandlers,
        settings: ServeSettings,
        log: AccessLog | None = None,
    ) -> None:
        self._application = application
        self._log = log
        self._doors = doors
        self._errors = errors
        self._timeout = settings.timeout
        self._is_first = True

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or answer why not."""
        if (kind := scope["type"]) == "lifespan":
            await self._application(scope, receive, send)
            return
        if self._is_first and (here := scope.get("server")):
            self._is_first = False
            self._doors.backlog.listens_on(here[1])
        if self._log is not None:
            send = self._log.begin(scope, _path(scope), send)
        reply = Reply(send)
        try:
            shown = _shown(scope["headers"])
            method = scope.get("method", "GET")
            if shown.is_browser:
                cross_site.refuse_cross_site(method, scope["headers"])
            key = self._doors.admit(permissions.of_request(kind, method, _path(scope)), shown.token)
            if key is not None:
                scope[KEY] = key
                if self._log is not None:
                    scope[LINE]["key"] = key.name
            if kind != "http" or lasts(_path(scope)):
                await self._application(scope, receive, reply.send)
                return
            timeout = self._timeout if shown.timeout is None else min(_seconds(shown.timeout), self._timeout)
            await within(timeout, self._application(scope, receive, reply.send))
        except LeagueError as error:
            if reply.is_begun:
                raise
            await self._refuse(error, scope, receive, send)
        except Expired:
            if not reply.is_begun:  # else the client does not read it, and the server hangs up
                await self._refuse(_too_late(scope, timeout), scope, receive, send)

    async def _refuse(self, error: LeagueError, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket" and DENIAL not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": str(error)[:120]})
            return
        await self._errors.response(_path(scope), error)(scope, receive, send)


class Reply:
    """Knows whether a reply was begun, to which nothing else can be said."""

    __slots__ = ("_send", "is_begun")

    def __init__(self, send: Send) -> None:
        self._send = send
        self.is_begun = False

    def send(self, message: Message) -> Awaitable[None]:
        """ASGI's send."""
        self.is_begun = True
        return self._send(message)


def _take(key: Key) -> None:
    """Count a call. Raises RateLimited."""
    if key.bucket is not None and (wait := key.bucket.take()):
        raise RateLimited(f"{key.name} may call {key.bucket.rate:g} times a second", wait)


def headers_of(metadata: Iterable[tuple[str, Any]] | None) -> list[tuple[bytes, bytes]]:
    """The metadata of a call of gRPC as headers."""
    return [(name.encode(), value.encode() if isinstance(value, str) else value) for name, value in metadata or ()]


class Shown(NamedTuple):
    """What the headers of a request say."""

    token: bytes | None
    """The key's text."""
    timeout: bytes | None
    """Its time limit, in milliseconds."""
    is_browser: bool
    """Whether a browser tells where it comes from."""


def _shown(headers: Iterable[tuple[bytes, bytes]]) -> Shown:
    token, timeout, is_browser = None, None, False
    for name, value in headers:
        if name in READ_HERE:
            if name == b"x-request-timeout-ms":
                timeout = value
            elif name == b"x-api-key":
                token = value.strip()
            elif name in cross_site.READ:
                is_browser = True
            elif value[: len(BEARER)].lower() == BEARER:
                token = value[len(BEARER) :].strip()
    return Shown(token, timeout, is_browser)


def _seconds(milliseconds: bytes) -> float:
    if not (milliseconds.isdigit() and len(milliseconds) <= 9 and int(milliseconds)):
        raise InvalidInput("x-request-timeout-ms must be a positive number of milliseconds")
    return int(milliseconds) / 1000


def _too_late(scope: Scope, timeout: float) -> LeagueError:
    if scope["method"] == "POST" and IS_READ not in scope:
        return BodyTooSlow(f"the body did not arrive within {timeout:g} s")
    return DeadlineExceeded(f"this was not answered within {timeout:g} s")


def _path(scope: Scope) -> str:
    """The path below the root path, as the router sees it."""
    path: str = scope["path"]
    root = scope.get("root_path", "")
    return path[len(root) :] if root and path.startswith(root) else path
