"""ASGI middleware that checks API keys, permissions, rate limits, load and cross-site requests.

Order of the checks, with the status of a refusal:

    host and origin → API key → rate limit → load → timeout → application
    403               401, 403  429          429    504

The timeout applies to HTTP requests only: gRPC calls have their own deadlines, and WebSocket and event streams are
long-lived.
"""

from collections.abc import Awaitable, Iterable
from time import monotonic
from typing import Any, NamedTuple, cast

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from league.errors import DeadlineExceeded, Forbidden, InvalidInput, LeagueError, RateLimited, Unauthenticated
from serve_app.access.access_log import LOG_ENTRY, AccessLog
from serve_app.access.api_keys import ApiKey, ApiKeyCache, TokenBucket
from serve_app.access.connection_limit import ConnectionLimit
from serve_app.access.errors import BodyTooSlow, ErrorHandlers
from serve_app.access.load_shedding import Backlog
from serve_app.access.permissions import Permissions, RequiredPermission, for_rpc
from serve_app.access.request_body import BODY_READ
from serve_app.access.request_origin import ORIGIN_HEADERS, reject_cross_site, reject_foreign_host
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.runtime.haproxy_script import KEY_ACCEPTED
from serve_app.runtime.timeouts import TimeLimitExceeded, run_within
from serve_app.settings import ServeSettings

KEY = "league.key"
"""Scope entry of a request with a valid key: its `ApiKey`."""
ADMISSION = "league.admission"
"""Scope entry of a request that was accepted before it reached the middleware: its `Admission`."""
DEADLINE = "league.deadline"
"""Scope entry of an HTTP request: when its timeout ends, as a time of `time.monotonic`."""
BEARER = b"bearer "
SUBPROTOCOL = "policy-league"
"""WebSocket subprotocol of streams. A page in a browser cannot set headers, and offers its key as another one."""
KEY_SUBPROTOCOL = b"policy-league.key."
HEADERS = ORIGIN_HEADERS | {b"authorization", b"sec-websocket-protocol", b"x-api-key", b"x-request-timeout-ms"}
KEY_HEADER = (KEY_ACCEPTED.encode(), b"1")
"""Header of a response to a request with a key."""
DENIAL = "websocket.http.response"
"""ASGI extension that sends an HTTP response when a WebSocket handshake is refused."""
POLICY_VIOLATION = 1008
UNLIMITED = ("/v1/policies/", "/v2/models/", "/v1/health/", "/v2/health/")
"""Paths of inference, which limits its requests in flight itself, and of health checks, which answer at once."""
FRAMES = 2000.0
"""Control frames and fragments per second that a replica handles for all streams without a key: a few percent of a
core, and four times the pings of 10,000 idle clients."""
INVALID_KEY = "the API key is unknown, revoked or expired"


class AccessControl:
    """Decides which requests are accepted.

    permissions: those that routes require. is_exposed: whether the server listens to other machines.
    """

    def __init__(
        self, api_keys: ApiKeyCache, settings: ServeSettings, permissions: Permissions, is_exposed: bool
    ) -> None:
        self._api_keys = api_keys
        self._permissions = permissions
        self._settings = settings
        self._is_exposed = is_exposed
        self.backlog = Backlog(settings.max_wait)
        self._frames = TokenBucket(FRAMES)

    @property
    def requires_key(self) -> bool:
        """Whether requests need an API key."""
        if self._settings.cors_origins:
            return True
        if self._settings.require_keys == "auto":
            return self._is_exposed or not self._api_keys.is_empty
        return self._settings.require_keys == "always"

    @property
    def is_local_only(self) -> bool:
        """Whether only programs and pages of this machine may call: on loopback, while no key exists."""
        return self._settings.require_keys == "auto" and not self.requires_key

    def admit(self, need: RequiredPermission, token: bytes | None) -> ApiKey | None:
        """Accept a request or an RPC, and return its key.

        Raises Unauthenticated, Forbidden, RateLimited or Overloaded.
        """
        key = self._identify(need, token)
        if key is not None:
            _check_league(key, need)
            _take_token(key)
        if need.scope == "act":
            self.backlog.admit()
        return key

    def admission(self, scope: Scope, path: str) -> "Admission":
        """Accept an HTTP request or a WebSocket handshake. path: relative to the root path.

        Raises UntrustedHost, CrossSiteRequest, and the errors of `admit`.
        """
        headers, method = _read_headers(scope["headers"]), scope.get("method", "GET")
        need = self._permissions.for_request(scope["type"], method, path)
        if self.is_local_only:
            reject_foreign_host(scope["headers"])
        if headers.is_browser:
            reject_cross_site(scope["type"], method, scope["headers"], self._settings.cors_origins)
        return Admission(headers, need, self.admit(need, headers.token))

    def admit_message(self, key: ApiKey | None, size: int) -> None:
        """Accept a message of a stream that was opened with `key`. size: in bytes.

        Raises Unauthenticated (also if the key is no longer valid), RateLimited or Overloaded.
        """
        self.check_key(key)
        if key is not None:
            _take_token(key)
        self.admit_body(key, size)

    def admit_frame(self, key: ApiKey | None) -> float:
        """Count a control frame or a fragment of a stream as a request of its key.

        Frames of all streams without a key have a rate together. Returns 0, or the number of seconds until the frame
        may be handled.
        """
        bucket = self._frames if key is None else key.bucket
        return 0.0 if bucket is None else bucket.take()

    def admit_body(self, key: ApiKey | None, size: int) -> None:
        """Accept a body, which may have arrived later than its request.

        It counts as one more request of its key per LARGE_BODY bytes. Raises RateLimited or Overloaded.
        """
        if key is not None and key.bucket is not None and (wait := key.bucket.owe(size // LARGE_BODY)):
            raise _rate_limited(key, key.bucket, wait)
        self.backlog.admit()

    def check_key(self, key: ApiKey | None) -> None:
        """Check the key of an open stream. Raises Unauthenticated if it is no longer valid."""
        if key is None:
            if self.requires_key:
                raise Unauthenticated("this stream now requires an API key")
        elif not self._api_keys.holds(key):
            raise Unauthenticated(f"the API key {key.name} was revoked or has expired")

    def presented_key(self, headers: Iterable[tuple[bytes, bytes]]) -> ApiKey | None:
        """The key in the headers of a request, or None. Raises Unauthenticated if it is invalid."""
        token = _read_headers(headers).token
        key = None if token is None else self._api_keys.find(token)
        if token is not None and key is None:
            raise Unauthenticated(INVALID_KEY)
        return key

    def may_read_all(self, headers: Iterable[tuple[bytes, bytes]]) -> bool:
        """Whether the presented key, if one is required, permits reading all leagues."""
        try:
            self.admit(RequiredPermission("read", None, is_of_all=True), _read_headers(headers).token)
        except LeagueError:
            return False
        return True

    def admit_rpc(self, metadata: Iterable[tuple[str, Any]] | None, rpc: str) -> ApiKey | None:
        """Accept an RPC of GRPCInferenceService before its message is read, and return its key.

        Raises Unauthenticated, Forbidden, RateLimited or Overloaded.
        """
        need = RequiredPermission(for_rpc(rpc, "").scope, None)
        return self.admit(need, _read_headers(headers_of(metadata)).token)

    def check_model(self, key: ApiKey | None, rpc: str, model: str) -> None:
        """Check that the key of an accepted RPC permits a model. Raises Forbidden."""
        if key is not None:
            _check_league(key, for_rpc(rpc, model))

    def _identify(self, need: RequiredPermission, token: bytes | None) -> ApiKey | None:
        """The key that a permission requires, None if it requires none. Raises Unauthenticated or Forbidden."""
        if need.scope is None or not (need.is_change or self.requires_key):
            return None
        key = None if token is None else self._api_keys.find(token)
        if key is None:
            if self._api_keys.is_empty:
                create = f"league keys create NAME --scope {need.scope}"
                raise Unauthenticated(f"this request requires an API key, and none exists: {create}")
            if token is None:
                raise Unauthenticated("this request requires an API key: Authorization: Bearer plk_…")
            raise Unauthenticated(INVALID_KEY)
        if need.scope not in key.scopes:
            allowed = ", ".join(sorted(key.scopes))
            raise Forbidden(f"this request requires the scope {need.scope}; the key {key.name} has {allowed}")
        return key


class AccessControlMiddleware:
    """ASGI middleware that applies `AccessControl` to every request."""

    def __init__(
        self,
        application: ASGIApp,
        access: AccessControl,
        errors: ErrorHandlers,
        settings: ServeSettings,
        log: AccessLog | None = None,
    ) -> None:
        self._application = application
        self._log = log
        self._access = access
        self._errors = errors
        self._timeout = settings.timeout
        self._in_flight = ConnectionLimit("requests", settings.max_in_flight, settings.max_in_flight)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request to the application, or respond with an error."""
        if (kind := scope["type"]) == "lifespan":
            await self._application(scope, receive, send)
            return
        path = _path(scope)
        if self._log is not None:
            send = self._log.begin(scope, path, send)
        response = ResponseTracker(send)
        try:
            headers, need, key = scope.pop(ADMISSION, None) or self._access.admission(scope, path)
            if key is not None:
                scope[KEY] = key
                response.has_key = True
                if self._log is not None:
                    scope[LOG_ENTRY]["key"] = key.name
            if kind != "http" or need.is_stream:
                await self._application(scope, receive, response.send)
                return
            timeout = self._timeout if headers.timeout is None else min(_seconds(headers.timeout), self._timeout)
            scope[DEADLINE] = monotonic() + timeout
            if path.startswith(UNLIMITED):
                await run_within(timeout, self._application(scope, receive, response.send))
                return
            with self._in_flight.opened(None):
                await run_within(timeout, self._application(scope, receive, response.send))
        except TimeLimitExceeded:
            if not response.has_started:  # otherwise the client is not reading, and uvicorn closes the connection
                await self._refuse(_timed_out(scope, timeout), scope, receive, response)
        except Exception as error:
            is_refusal = isinstance(error, LeagueError) and not response.has_started
            if is_refusal or kind == "http":
                await self._refuse(error, scope, receive, response)
            if not is_refusal:
                raise

    async def _refuse(self, error: Exception, scope: Scope, receive: Receive, response: "ResponseTracker") -> None:
        if scope["type"] == "websocket" and DENIAL not in scope.get("extensions", {}):
            reason = cast(LeagueError, error).public_message[:120]
            await response.send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": reason})
            return
        answer = self._errors.response(_path(scope), error)
        if not response.has_started:
            await answer(scope, receive, response.send)


class ResponseTracker:
    """Records whether a response has started; after that no error response can be sent."""

    __slots__ = ("_send", "has_key", "has_started")

    def __init__(self, send: Send) -> None:
        self._send = send
        self.has_key = False
        """Whether the response gets KEY_HEADER."""
        self.has_started = False

    def send(self, message: Message) -> Awaitable[None]:
        """ASGI `send`."""
        if not self.has_started:
            self.has_started = True
            if self.has_key:
                message["headers"] = [*message.get("headers", ()), KEY_HEADER]
        return self._send(message)


def _check_league(key: ApiKey, need: RequiredPermission) -> None:
    """Raise Forbidden if a key is restricted to other leagues."""
    if key.leagues is not None and need.league not in key.leagues and (need.league or need.is_of_all):
        allowed, what = ", ".join(sorted(key.leagues)), "all leagues" if need.is_of_all else "another league"
        raise Forbidden(f"this request concerns {what}; the key {key.name} is restricted to {allowed}")


def _take_token(key: ApiKey) -> None:
    """Take a token of the key's bucket. Raises RateLimited."""
    if key.bucket is not None and (wait := key.bucket.take()):
        raise _rate_limited(key, key.bucket, wait)


def _rate_limited(key: ApiKey, bucket: TokenBucket, wait: float) -> RateLimited:
    return RateLimited(f"rate limit exceeded: the key {key.name} allows {bucket.rate:g} requests per second", wait)


def headers_of(metadata: Iterable[tuple[str, Any]] | None) -> list[tuple[bytes, bytes]]:
    """gRPC metadata as ASGI headers."""
    return [(name.encode(), value.encode() if isinstance(value, str) else value) for name, value in metadata or ()]


class RequestHeaders(NamedTuple):
    """The headers of a request that access control uses."""

    token: bytes | None
    """The text of the API key."""
    timeout: bytes | None
    """The requested timeout in milliseconds."""
    is_browser: bool
    """Whether the request has a header of ORIGIN_HEADERS."""


class Admission(NamedTuple):
    """An accepted request."""

    headers: RequestHeaders
    need: RequiredPermission
    key: ApiKey | None
    """None if it needs no key."""


def _read_headers(headers: Iterable[tuple[bytes, bytes]]) -> RequestHeaders:
    token, timeout, is_browser = None, None, False
    for name, value in headers:
        if name in HEADERS:
            if name == b"x-request-timeout-ms":
                timeout = value
            elif name == b"x-api-key":
                token = value.strip()
            elif name in ORIGIN_HEADERS:
                is_browser = True
            elif name == b"sec-websocket-protocol":
                offered = (protocol.strip() for protocol in value.split(b","))
                token = next(
                    (text[len(KEY_SUBPROTOCOL) :] for text in offered if text.startswith(KEY_SUBPROTOCOL)), token
                )
            elif value[: len(BEARER)].lower() == BEARER:
                token = value[len(BEARER) :].strip()
    return RequestHeaders(token, timeout, is_browser)


def _seconds(milliseconds: bytes) -> float:
    if not (milliseconds.isdigit() and len(milliseconds) <= 9 and int(milliseconds)):
        raise InvalidInput("x-request-timeout-ms must be a positive number of milliseconds")
    return int(milliseconds) / 1000


def _timed_out(scope: Scope, seconds: float) -> LeagueError:
    if scope["method"] == "POST" and BODY_READ not in scope:
        return BodyTooSlow(f"the request body did not arrive within {seconds:g} s")
    return DeadlineExceeded(f"the request timed out after {seconds:g} s")


def _path(scope: Scope) -> str:
    """The path below the root path, as the router sees it."""
    path: str = scope["path"]
    root = scope.get("root_path", "")
    return path[len(root) :] if root and path.startswith(root) else path
