"""Routes of the Open Inference Protocol over REST, below /v2.

A model is `{league}` or `{league}.{policy}`; a version is a number or an alias, by default the champion. Statistics are
sums over all replicas. Errors are `{"error": "…"}`.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

from starlette.requests import Request
from starlette.types import Receive, Scope, Send

from league.errors import InvalidInput, NotReady
from serve_app.access.request_body import MAX_CHANGE_BODY, parse_json_object, read_bytes
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.declaration import CALLER, REPLICA_HEADER, TIMEOUT, Declaration, Parameter
from serve_app.inference.http_route import JSON, HttpRoute, Reply
from serve_app.inference.stream_codec import BinaryObservations
from serve_app.inference_protocol.catalogue import ModelCatalogue
from serve_app.inference_protocol.inference import API, Inference, Outputs
from serve_app.inference_protocol.rest_codec import RestRequest, read_request, write_response
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.live_versions.registry_watcher import RegistryWatcher
from serve_app.live_versions.traffic_split import Headers

BINARY = b"application/octet-stream"
BODIES = ("application/json", BINARY.decode())
HEADER_LENGTH = b"inference-header-content-length"
LENGTH_DIGITS = 10
"""Maximum digits of a length header."""


TAG = "Open Inference Protocol"
Handler = TypeVar("Handler", bound=Callable[..., Any])


def of_model_and_version(declaration: Declaration) -> Callable[[Handler], Handler]:
    """Declare a route of a model, and the same of one of its versions."""
    of_version = replace(
        declaration,
        path=declaration.path.replace("{model}", "{model}/versions/{version}"),
        name=f"version_{declaration.name.removeprefix('model_')}",
        summary=declaration.summary.replace("model", "version"),
    )
    return lambda handler: declaration(of_version(handler))


class RestRoutes:
    """The endpoints."""

    def __init__(self, inference: Inference, catalogue: ModelCatalogue, watcher: RegistryWatcher) -> None:
        self._inference = inference
        self._catalogue = catalogue
        self._watcher = watcher

    @Declaration(
        "GET",
        "/v2",
        "ServerMetadata",
        scope="read",
        tag=TAG,
        success="The name and the extensions.",
        is_of_all=False,
    )
    async def server_metadata(self, _: Request) -> Any:
        """Get server metadata."""
        return self._catalogue.server()

    @Declaration("GET", "/v2/health/live", "ServerLive", scope=None, tag="Server", success="The process responds.")
    async def server_live(self, _: Request) -> Any:
        """Liveness check."""
        return {"live": True}

    @Declaration(
        "GET",
        "/v2/health/ready",
        "ServerReady",
        scope=None,
        tag="Server",
        success="All versions that the registry names are loaded.",
        errors=(NotReady,),
    )
    async def server_ready(self, _: Request) -> Any:
        """Readiness check."""
        if not self._watcher.is_ready:
            raise NotReady("this replica has not loaded the registry's aliases yet")
        return {"ready": True}

    @Declaration(
        "POST",
        "/v2/repository/index",
        "RepositoryIndex",
        scope="read",
        tag=TAG,
        success="The index.",
        body="IndexRequest",
        is_body_optional=True,
    )
    async def repository_index(self, request: Request) -> Any:
        """List all versions of all policies."""
        body = await read_bytes(request.scope, request.receive, MAX_CHANGE_BODY)
        options = parse_json_object(body) if body else {}
        only_ready = False if (ready := options.pop("ready", None)) is None else ready
        if any(value is not None for value in options.values()) or type(only_ready) is not bool:
            raise InvalidInput('the body must be {"ready": true}, {"ready": false} or empty')
        return await self._catalogue.index(only_ready)

    @Declaration(
        "GET",
        "/v2/models/stats",
        "Statistics",
        scope="read",
        tag=TAG,
        name="all_statistics",
        summary="Get statistics of all models",
        success="The statistics.",
    )
    @of_model_and_version(
        Declaration(
            "GET",
            "/v2/models/{model}/stats",
            "Statistics",
            scope="read",
            tag=TAG,
            name="model_statistics",
            summary="Get statistics of a model",
            success="The statistics.",
        )
    )
    async def statistics(self, _: Request, model: str = "", version: str = "") -> Any:
        """Get statistics.

        Sums over the replicas, each since it started. Times are in nanoseconds.
        """
        return await self._catalogue.statistics(model, version)

    @of_model_and_version(
        Declaration(
            "GET",
            "/v2/models/{model}",
            "ModelMetadata",
            scope="read",
            tag=TAG,
            name="model_metadata",
            summary="Get metadata of a model",
            success="The inputs, outputs and versions.",
        )
    )
    async def metadata(self, _: Request, model: str, version: str = "") -> Any:
        """Get the names, datatypes and shapes of inputs and outputs."""
        return await self._catalogue.metadata(model, version)

    @of_model_and_version(
        Declaration(
            "GET",
            "/v2/models/{model}/ready",
            "ModelReady",
            scope="read",
            tag=TAG,
            name="model_ready",
            summary="Readiness check of a model",
            success="The model is ready.",
        )
    )
    async def ready(self, _: Request, model: str, version: str = "") -> Any:
        """Readiness check."""
        await self._inference.find(model, version)
        return {"name": model, "ready": True}

    @of_model_and_version(
        Declaration(
            "GET",
            "/v2/models/{model}/config",
            "ModelConfig",
            scope="read",
            tag=TAG,
            name="model_config",
            summary="Get the configuration of a model",
            success="The configuration in the format of Triton.",
        )
    )
    async def config(self, _: Request, model: str, version: str = "") -> Any:
        """Get the configuration."""
        return await self._catalogue.config(model, version)


MAX_HEAD = 1024
"""Bytes of the longest JSON that is kept."""
MAX_HEADS = 64
"""JSON texts that are kept for a policy: callers can send any."""


class Layout(NamedTuple):
    """What the JSON of a valid request says if all its inputs are binary. size: of the body."""

    request: RestRequest
    tensors: Sequence[slice]
    """Place of each input of the policy in the body."""
    size: int
    rows: int


class InferRoute(HttpRoute):
    """POST …/infer: the hot path.

    A caller sends nearly the same JSON before the tensors of each request. What it says is parsed and checked once.
    """

    api = API

    def __init__(self, inference: Inference, replica: str) -> None:
        super().__init__(inference.serving, replica)
        self._inference = inference
        self._layouts: WeakKeyDictionary[LoadedPolicy, dict[bytes, Layout]] = WeakKeyDictionary()

    @of_model_and_version(
        Declaration(
            "POST",
            "/v2/models/{model}/infer",
            "InferResponse",
            scope="act",
            tag=TAG,
            name="infer",
            summary="Run inference with a model",
            success="The requested outputs, by default all, as JSON or as JSON followed by binary tensors.",
            media=BODIES,
            headers=(
                REPLICA_HEADER,
                Parameter(
                    "Inference-Header-Content-Length",
                    {"type": "integer"},
                    "Length of the JSON part in bytes, if binary tensors follow it.",
                ),
            ),
            parameters=(
                Parameter(
                    "Inference-Header-Content-Length",
                    {"type": "integer", "minimum": 0, "maximum": 10**LENGTH_DIGITS - 1},
                    "Length of the JSON part in bytes; required if binary tensors follow it.",
                    "header",
                ),
                CALLER,
                TIMEOUT,
            ),
            body="InferRequest",
            body_media=BODIES,
        )
    )
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run inference.

        Inputs must have the names, datatypes and shapes of `GET /v2/models/{model}`, with a leading batch dimension;
        they are not converted. Omit recurrent state at the start of episodes; afterwards send `state_out_<i>` back as
        `state_in_<i>`.

        The body is JSON, optionally followed by binary tensors; then `Inference-Header-Content-Length` is the length of
        the JSON part. It can be compressed (`Content-Encoding: gzip` or `deflate`).
        """
        await self.respond(scope, receive, send, scope["path_params"].get("version", ""))

    async def answer(self, model: str, version: str, headers: Headers, body: bytes, begun: int) -> Reply:
        """See `HttpRoute`."""
        header_length = json_length(headers)
        policy = await self._inference.find(model, version, headers)
        head = body[:header_length] if header_length is not None and header_length <= MAX_HEAD else b""
        layout, inputs = self._layouts.get(policy, {}).get(head), None
        if layout is not None and len(body) == layout.size:
            request, inputs = layout.request, BinaryObservations([body[part] for part in layout.tensors], layout.rows)
        elif len(body) > LARGE_BODY:
            policy.limits.check_body(memoryview(body)[:header_length], self.serving.settings.max_batch)
            request = await asyncio.to_thread(read_request, body, header_length)
        else:
            request = read_request(body, header_length)

        def write(outputs: Outputs) -> tuple[bytes, int | None]:
            return write_response(model, policy.number, outputs, request)

        content, length = await self._inference.infer(policy, request.infer, write, begun, inputs)
        if head and inputs is None and len(body) <= LARGE_BODY:
            self._keep(policy, head, request)
        lines = JSON if length is None else ((b"content-type", BINARY), (HEADER_LENGTH, b"%d" % length))
        return Reply(policy.number, content, lines)

    def _keep(self, policy: LoadedPolicy, head: bytes, request: RestRequest) -> None:
        """Keep what the JSON of a valid request says, if all its inputs are binary."""
        tensors, end = {}, len(head)
        for tensor in request.infer.inputs:
            tensors[tensor.name] = slice(end, end := end + len(tensor.data))
        if all(isinstance(tensor.data, memoryview) for tensor in request.infer.inputs) and not policy.state:
            layouts = self._layouts.setdefault(policy, {})
            if len(layouts) == MAX_HEADS:
                layouts.clear()
            rows = request.infer.inputs[0].shape[0]
            request = request._replace(infer=request.infer._replace(inputs=()))  # which refer to the body
            layouts[head] = Layout(request, [tensors[port.name] for port in policy.observed], end, rows)


def json_length(headers: Headers) -> int | None:
    """Inference-Header-Content-Length: bytes of the JSON if binary tensors follow it. Raises InvalidInput."""
    value = next((value for name, value in headers if name == HEADER_LENGTH), None)
    if value is not None and (not value.isdigit() or len(value) > LENGTH_DIGITS):
        raise InvalidInput("Inference-Header-Content-Length must be a number of bytes")
    return None if value is None else int(value)
