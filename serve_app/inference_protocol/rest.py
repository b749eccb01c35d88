"""Routes of the Open Inference Protocol over REST, below /v2.

    GET   v2, v2/health/live, v2/health/ready, v2/models/M[/versions/V], …/ready, …/config, …/stats, v2/models/stats
    POST  v2/models/M[/versions/V]/infer, v2/repository/index

M is `{league}` or `{league}.{policy}`; V is a number or an alias, by default the champion. Statistics are sums
over all replicas. Errors are `{"error": "…"}`.
"""

import asyncio
from typing import Any

import orjson
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from league.errors import InvalidInput, NotReady
from serve_app.access.access_control import KEY, AccessControl
from serve_app.access.access_log import LOG_ENTRY, log_version
from serve_app.access.request_body import MAX_CHANGE_BODY, parse_json_object, read_bytes
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.action_request import REPLICA
from serve_app.inference_protocol.catalogue import ModelCatalogue
from serve_app.inference_protocol.inference import Inference, InferResponse
from serve_app.inference_protocol.rest_codec import compressed, read_request, write_response
from serve_app.models.registry_watcher import RegistryWatcher
from serve_app.settings import ServeSettings

JSON, BINARY = b"application/json", b"application/octet-stream"
HEADER_LENGTH = b"inference-header-content-length"
LENGTH_DIGITS = 10
"""Maximum digits of a length header."""


class RestRoutes:
    """The endpoints."""

    def __init__(
        self,
        inference: Inference,
        catalogue: ModelCatalogue,
        watcher: RegistryWatcher,
        access: AccessControl,
        settings: ServeSettings,
        replica: str,
    ) -> None:
        self._infer = InferRoute(inference, access, settings, replica)
        self._inference = inference
        self._catalogue = catalogue
        self._watcher = watcher

    def routes(self) -> list[Route]:
        """Routes for Starlette, the most frequent first."""
        infer = [
            Route(f"{model}/infer", self._infer, methods=["POST"])
            for model in ("/v2/models/{model}", "/v2/models/{model}/versions/{version}")
        ]
        server = [
            Route("/v2", self._server),
            Route("/v2/health/live", self._live),
            Route("/v2/health/ready", self._ready),
            Route("/v2/repository/index", self._index, methods=["POST"]),
            Route("/v2/models/stats", self._statistics),
        ]
        of_models = [
            Route(f"{model}{path}", endpoint)
            for model in ("/v2/models/{model}", "/v2/models/{model}/versions/{version}")
            for path, endpoint in (
                ("", self._metadata),
                ("/ready", self._model_ready),
                ("/config", self._config),
                ("/stats", self._statistics),
            )
        ]
        return [*infer, *server, *of_models]

    async def _server(self, _: Request) -> Response:
        return _json(self._catalogue.server())

    async def _live(self, _: Request) -> Response:
        return _json({"live": True})

    async def _ready(self, _: Request) -> Response:
        if not self._watcher.is_ready:
            raise NotReady("this replica has not loaded the registry's aliases yet")
        return _json({"ready": True})

    async def _model_ready(self, request: Request) -> Response:
        model, version = _named(request)
        await self._inference.find(model, version)
        return _json({"name": model, "ready": True})

    async def _metadata(self, request: Request) -> Response:
        return _json(await self._catalogue.metadata(*_named(request)))

    async def _config(self, request: Request) -> Response:
        return _json(await self._catalogue.config(*_named(request)))

    async def _statistics(self, request: Request) -> Response:
        return _json(await self._catalogue.statistics(*_named(request)))

    async def _index(self, request: Request) -> Response:
        body = await read_bytes(request.scope, request.receive, MAX_CHANGE_BODY)
        options = parse_json_object(body) if body else {}
        only_ready = False if (ready := options.pop("ready", None)) is None else ready
        if any(value is not None for value in options.values()) or type(only_ready) is not bool:
            raise InvalidInput('the body must be {"ready": true}, {"ready": false} or empty')
        return _json(await self._catalogue.index(only_ready))


class InferRoute:
    """POST …/infer as a plain ASGI application: the hot path."""

    def __init__(self, inference: Inference, access: AccessControl, settings: ServeSettings, replica: str) -> None:
        self._inference = inference
        self._access = access
        self._settings = settings
        self._replica = (REPLICA, replica.encode())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a POST. Raises LeagueError."""
        with self._inference.admitted():
            await self._handle(scope, receive, send)

    async def _handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        header_length, accepted = _headers(scope)
        turn = self._access.backlog.turn
        body = await read_bytes(scope, receive, self._settings.max_body)
        if (is_large := len(body) > LARGE_BODY) or turn != self._access.backlog.turn:
            self._access.admit_body(scope.get(KEY), len(body))
        model, version = scope["path_params"]["model"], scope["path_params"].get("version", "")
        if is_large:
            served = await self._inference.find(model, version)
            served.policy.limits.check_body(memoryview(body)[:header_length], self._settings.max_batch)
            request = await asyncio.to_thread(read_request, model, version, body, header_length)
        else:
            request = read_request(model, version, body, header_length)

        def write(response: InferResponse) -> tuple[bytes, int | None]:
            if LOG_ENTRY in scope:
                log_version(scope, response.model, int(response.version))
            return write_response(response, request)

        response, length = await self._inference.infer(request.infer, write, scope["headers"])
        headers = [self._replica, (b"content-type", JSON if length is None else BINARY)]
        if length is not None:
            headers.append((HEADER_LENGTH, b"%d" % length))
        if accepted:
            response, encoding = await compressed(response, accepted)
            headers.append((b"vary", b"accept-encoding"))
            if encoding is not None:
                headers.append((b"content-encoding", encoding))
        headers.append((b"content-length", b"%d" % len(response)))
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": response})


def _headers(scope: Scope) -> tuple[int | None, bytes]:
    """Inference-Header-Content-Length and Accept-Encoding. Raises InvalidInput."""
    header_length, accepted = None, b""
    for name, value in scope["headers"]:
        if name == HEADER_LENGTH:
            if not value.isdigit() or len(value) > LENGTH_DIGITS:
                raise InvalidInput("Inference-Header-Content-Length must be a number of bytes")
            header_length = int(value)
        elif name == b"accept-encoding":
            accepted = value
    return header_length, accepted


def _named(request: Request) -> tuple[str, str]:
    """Model and version of a path, empty if absent."""
    return request.path_params.get("model", ""), request.path_params.get("version", "")


def _json(document: Any) -> Response:
    return Response(orjson.dumps(document), media_type="application/json")
