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

import orjson
from starlette.types import Receive, Scope, Send

from league.errors import IllegalMask, InvalidState, NotReady, ObservationError
from league.refs import CHAMPION
from serve_app.access.request_body import parse_json_object, read_body
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.declaration import CALLER, REPLICA_HEADER, TIMEOUT, VERSION, Declaration
from serve_app.inference.action_request import (
    KEYS,
    build_response,
    decode_state,
    encode_state,
    json_observations,
    parse_action_request,
    pinned_version,
    reject_unknown_keys,
)
from serve_app.inference.http_route import HttpRoute, Reply
from serve_app.live_versions.traffic_split import Headers
from serve_app.routes.query_string import query_params

PATH_PREFIX, PATH_SUFFIX = "/v1/policies/", "/action"
API = "action"
"""Name of this route in metrics."""


class ActionRoute(HttpRoute):
    """The endpoint."""

    api = API

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
        await self.respond(scope, receive, send, query_params(scope).get("version", CHAMPION), read_body)

    async def answer(self, model: str, version: str, headers: Headers, body: bytes, begun: int) -> Reply:
        """See `HttpRoute`."""
        models, max_batch = self.serving.models, self.serving.settings.max_batch
        if len(body) > LARGE_BODY:
            with suppress(NotReady):  # without a champion, a token in the body may name the version
                policy = await models.find(model, version)
                policy.limits.check_body(body, max_batch)
            document = await asyncio.to_thread(parse_json_object, body)
        else:
            document = parse_json_object(body)
        reject_unknown_keys(document, KEYS)
        request = parse_action_request(document, max_batch)
        if request.tokens is not None and any(request.tokens):
            version = pinned_version(request, model, version, await models.members(model, version))
        policy = await models.find(model, version, headers)
        observations = json_observations(request, policy, body)
        answer = await self.serving.act(policy, observations, request.options, decode_state(request, policy))
        response = build_response(request, answer, policy)
        if (state := answer.output.state) is not None:
            tokens = encode_state(state, policy)
            response["state"] = tokens if request.is_batch else tokens[0]
        content = orjson.dumps(response)[:-1] + policy.signature(model)
        self.serving.metrics.count_request(API, policy, observations.rows, begun)
        return Reply(policy.number, content)
