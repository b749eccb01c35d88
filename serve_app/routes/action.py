"""POST /v1/policies/{model}/action: observations to actions, the hot path.

    request   {"observation": …}  or  {"observations": [ … ]};  optional "state", "explore", "seed", "probabilities",
                                                                  "deadline_ms", "analysis"
    response  {"action": …}       or  {"actions": [ … ]};       with "model", "version", "sha256" and requested fields

`seed` is an integer, or a list with one per observation. With a seed of its own an observation gets the same action in
every batch; with a common seed, the same action at the same position. `state` is null or the `state` of an earlier
response: one token per observation, whose version answers; or arrays, name → nested lists with one row per observation,
to which the response has arrays, too. `sha256` is the digest of the version's manifest.json, which contains the digests
of all its files.
"""

import asyncio
from contextlib import suppress
from time import perf_counter_ns
from typing import Any

import orjson
from starlette.types import ASGIApp, Receive, Scope, Send

from league.errors import IllegalMask, InvalidState, NotReady, ObservationError
from league.refs import CHAMPION
from serve_app.access.access_control import KEY
from serve_app.access.access_log import LOG_ENTRY, log_version
from serve_app.access.request_body import parse_json_object, read_body
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.declaration import CALLER, REPLICA_HEADER, TIMEOUT, VERSION, Declaration
from serve_app.inference.action_request import (
    KEYS,
    REPLICA,
    DecodedActionRequest,
    build_response,
    decode_state,
    encode_state,
    is_plain,
    parse_action_request,
    pinned_version,
    read_observations,
    reject_unknown_keys,
)
from serve_app.inference.serving import Serving
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.routes.query_string import query_params

PATH_PREFIX, PATH_SUFFIX = "/v1/policies/", "/action"
API = "action"
"""Name of this route in metrics."""


class ActionRoute:
    """The endpoint as a plain ASGI application."""

    def __init__(self, serving: Serving, replica: str) -> None:
        self._serving = serving
        self._replica = (REPLICA, replica.encode())

    @Declaration(
        "POST",
        f"{PATH_PREFIX}{{model}}{PATH_SUFFIX}",
        "ActionResponse",
        scope="act",
        tag="Inference",
        name="act",
        success="The actions in the order of the observations.",
        headers=(REPLICA_HEADER,),
        parameters=(VERSION, CALLER, TIMEOUT),
        body="ActionRequest",
        errors=(ObservationError, IllegalMask, InvalidState),
    )
    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Compute actions.

        `model` is a league, or `league.policy` if its versions have several policies. Without `version` the champion is
        used. The call has no side effects, so it can be retried.

        **Observations.** Arrays are nested lists or base64. `{"b64": "…"}` contains the bytes of the array (row-major,
        little-endian); `dtype` and `shape` are optional and must match the policy. `{"png": "…"}` contains an image
        with 8 bits per channel (grayscale, grayscale with alpha, RGB or RGBA), and `{"png": ["…", "…"]}` several images
        that are stacked along the last axis.

        **Recurrent policies** return `state`, a token. Send it with the next observation; omit it (or send null) at the
        start of an episode. The version that issued the token serves the episode until it ends, even if `champion`
        changes.
        """
        with self._serving.admitted(API):
            await self._handle(scope, receive, send)

    async def _handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        start = perf_counter_ns()
        serving, max_batch = self._serving, self._serving.settings.max_batch
        turn = serving.access.backlog.turn
        body = await read_body(scope, receive, serving.settings.max_body)
        model, requested = scope["path_params"]["model"], query_params(scope).get("version", CHAMPION)
        if (is_large := len(body) > LARGE_BODY) or turn != serving.access.backlog.turn:
            serving.access.admit_body(scope.get(KEY), len(body))
        if is_large:
            with suppress(NotReady):  # without a champion, a token in the body may name the version
                policy = await serving.models.find(model, requested)
                policy.limits.check_body(body, max_batch)
            document = await asyncio.to_thread(parse_json_object, body)
        else:
            document = parse_json_object(body)
        reject_unknown_keys(document, KEYS)
        request = parse_action_request(document, max_batch)
        members = await serving.models.members(model, requested) if request.tokens and any(request.tokens) else ()
        requested = pinned_version(request, model, requested, members)
        policy = await serving.models.find(model, requested, scope["headers"])
        response = await self._response(request, body, policy)
        if LOG_ENTRY in scope:
            log_version(scope, model, policy.number)
        content = orjson.dumps(response)[:-1] + policy.signature(model)
        headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(content)), self._replica]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": content})
        serving.count(API, policy, len(request.observations), start)

    async def _response(self, request: DecodedActionRequest, body: bytes, policy: LoadedPolicy) -> dict[str, Any]:
        plain = is_plain(request, policy, body.count(b'"'))
        observations = await read_observations(request, policy, plain, len(body))
        state = decode_state(request, policy, not plain)
        output = await self._serving.act(policy, observations, request.options, state)
        response = build_response(request, output, observations, policy)
        if output.state is not None:
            if request.state is not None:
                response["state"] = {name: array.tolist() for name, array in output.state.items()}
            else:
                tokens = encode_state(output.state, policy)
                response["state"] = tokens if request.is_batch else tokens[0]
        return response


class ActionDispatch:
    """Sends action requests to their route without searching the routing table, and others to the application."""

    def __init__(self, application: ASGIApp, action: ActionRoute) -> None:
        self._application = application
        self._action = action

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Dispatch a request. Raises LeagueError."""
        path = scope["path"] if scope["type"] == "http" else ""
        if path.startswith(PATH_PREFIX) and path.endswith(PATH_SUFFIX) and scope["method"] == "POST":
            model = path[len(PATH_PREFIX) : -len(PATH_SUFFIX)]
            if model and "/" not in model:
                scope["path_params"] = {"model": model}
                await self._action(scope, receive, send)
                return
        await self._application(scope, receive, send)
