"""A stream session: answers each message with the version and recurrent state that the stream keeps.

A stream is pinned to a version, or follows an alias. A stream that follows an alias switches versions of a recurrent
policy, and members of a mixture, only when all its episodes start anew.
"""

import asyncio
from math import ceil
from time import perf_counter_ns
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from league.errors import InvalidInput, InvalidState, LeagueError, RateLimited, Unauthenticated
from league.policies.policy import Arrays
from league.refs import CHAMPION
from league.spaces.observation_codec import json_type
from serve_app.access.access_control import POLICY_VIOLATION
from serve_app.access.api_keys import ApiKey
from serve_app.access.errors import MalformedBody, status_of
from serve_app.access.request_body import parse_json_object
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.inference.action_request import (
    KEYS,
    DecodedActionRequest,
    build_response,
    decode_state,
    encode_state,
    json_observations,
    parse_action_request,
    parse_flag,
    pinned_version,
    reject_unknown_keys,
)
from serve_app.inference.serving import Serving
from serve_app.inference.stream_codec import binary_observations, parse_request, write_actions
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.live_versions.resolver import policy_ref
from serve_app.live_versions.traffic_split import Headers, acting
from serve_app.runtime.ray_serve import logger
from serve_app.runtime.uvicorn_websocket import CloseStream, StreamMessage

STREAM_ONLY_KEYS = frozenset(("reset", "return_state"))
"""Keys that the action route does not accept."""
INVALID_PAYLOAD = 1007
API = "stream"
"""Name of stream messages in metrics."""
INTERNAL_ERROR = {"code": "internal_error", "message": "internal server error; see the server log", "status": 500}


class StreamSession:
    """The session of one connection; messages are passed in one at a time.

    follows: the alias to follow; None pins the version of `policy`. headers: those of the handshake; the caller's key
    may route a stream that follows the champion to the canary, and selects the member of a mixture.
    """

    def __init__(
        self,
        serving: Serving,
        model: str,
        policy: LoadedPolicy,
        follows: str | None,
        headers: Headers,
        key: ApiKey | None,
    ) -> None:
        self._serving = serving
        self._model = model
        self._ref = policy_ref(model)
        self._path = f"/v1/policies/{model}/stream"
        self._follows = follows
        self._headers = headers
        self._key = key
        self._policy = policy
        self._state: dict[str, NDArray] | None = None
        """Recurrent state, one row per observation of the last message; None at the start of episodes."""
        self._is_batch = False

    async def answer(self, data: bytes, is_text: bool) -> StreamMessage:
        """The answer to a message, or an error message. Raises CloseStream."""
        try:
            self._serving.access.admit_message(self._key, len(data))
            return await (self._answer_text(data) if is_text else self._answer_binary(data))
        except Unauthenticated as error:
            self._serving.metrics.count_error(self._path, error.code)
            raise CloseStream(POLICY_VIOLATION, str(error)) from None
        except LeagueError as error:
            self._serving.metrics.count_error(self._path, error.code)
            return error_message(error, self._serving.settings.retry)
        except CloseStream:
            raise
        except Exception as error:
            logger.error("a message of a stream failed", exc_info=error)
            self._serving.metrics.count_error(self._path, str(INTERNAL_ERROR["code"]))
            return _text(INTERNAL_ERROR)

    def admit_frame(self) -> float:
        """Count a control frame or a fragment. Returns 0, or the number of seconds until it may be handled."""
        return self._serving.access.admit_frame(self._key)

    def closing_message(self) -> StreamMessage | None:
        """What a client needs to continue on another replica: the recurrent state, if any."""
        if self._state is None:
            return None
        return self._signed({"closing": True, "state": self._tokens()})

    async def _answer_text(self, data: bytes) -> StreamMessage:
        start = perf_counter_ns()
        if is_large := len(data) > LARGE_BODY:
            self._policy.limits.check_body(data, self._serving.settings.max_batch)
        document = await asyncio.to_thread(_parsed, data) if is_large else _parsed(data)
        reject_unknown_keys(document, KEYS | STREAM_ONLY_KEYS)
        stream_keys = document.keys() & STREAM_ONLY_KEYS
        if document.keys() == {"reset"} and parse_flag(document, "reset"):
            self._policy, self._state = self._current(is_anew=True), None
            return self._signed({"reset": True})
        return_state, reset = parse_flag(document, "return_state"), document.get("reset", False)
        for key in stream_keys:
            del document[key]
        request = parse_action_request(document, self._serving.settings.max_batch)
        is_anew = reset is True or ("state" in document and document["state"] is None)
        policy, state = await self._select(request, is_anew, _resets(reset, request))
        observations = json_observations(request, policy, data, len(stream_keys))
        answer = await self._serving.act(policy, observations, request.options, state)
        self._policy, self._state, self._is_batch = policy, answer.output.state, request.is_batch
        response = build_response(request, answer, policy)
        if return_state and self._state is not None:
            response["state"] = self._tokens()
        message = self._signed(response)
        self._serving.metrics.count_request(API, policy, observations.rows, start)
        return message

    async def _answer_binary(self, data: bytes) -> StreamMessage:
        start = perf_counter_ns()
        request = parse_request(data, self._serving.settings.max_batch)
        policy, state = self._continue(request.rows, request.reset, request.resets)
        observations = binary_observations(policy, request)
        answer = await self._serving.act(policy, observations, request.options, state)
        self._policy, self._state, self._is_batch = policy, answer.output.state, request.rows > 1
        message = StreamMessage(write_actions(policy, answer.actions), False)
        self._serving.metrics.count_request(API, policy, request.rows, start)
        return message

    async def _select(
        self, request: DecodedActionRequest, is_anew: bool, resets: NDArray | None
    ) -> tuple[LoadedPolicy, Arrays | None]:
        """The policy that answers, and the recurrent state. Raises InvalidState and the errors of
        `ModelResolver.find`.
        """
        if request.tokens is None or not any(request.tokens):
            return self._continue(len(request.observations), is_anew or request.tokens is not None, resets)
        if is_anew or resets is not None:
            raise InvalidState("reset and state are mutually exclusive: an episode starts or continues")
        number = pinned_version(request, self._model, self._follows or str(self._policy.number))
        policy = self._policy
        if int(number) != policy.number:
            policy = await self._serving.models.find(self._model, number)
        return policy, decode_state(request, policy)

    def _continue(self, rows: int, is_anew: bool, resets: NDArray | None) -> tuple[LoadedPolicy, Arrays | None]:
        is_anew = is_anew or (resets is not None and bool(resets.all()))
        if self._state is None or is_anew:
            return self._current(is_anew), None
        held = len(next(iter(self._state.values())))
        if held != rows:
            raise InvalidState(f"the last message had {held} observations, this one has {rows}: a reset is required")
        if resets is None or not resets.any():
            return self._policy, self._state
        state = {name: array.copy() for name, array in self._state.items()}
        for array in state.values():
            array[resets] = 0
        return self._policy, state

    def _current(self, is_anew: bool) -> LoadedPolicy:
        """The policy that answers now, if no recurrent state depends on it. is_anew: whether episodes start."""
        version = None
        if self._follows is not None:
            version = self._serving.slots.follow(self._ref.league, self._follows)
        if version is None:
            return self._policy
        if self._follows == CHAMPION and self._serving.traffic.canaries:
            version = self._serving.traffic.route(version, self._headers)
        # An episode stays with the member of a mixture that it began with.
        if version.mixture is not None:
            is_member = any(member.policies.get(self._policy.name) is self._policy for member in version.members)
            if is_member and not is_anew:
                return self._policy
            version = acting(version, self._headers)
        return version.policy(self._ref.policy)

    def _tokens(self) -> str | list[str]:
        assert self._state is not None
        tokens = encode_state(self._state, self._policy)
        return tokens if self._is_batch else tokens[0]

    def _signed(self, document: dict[str, Any]) -> StreamMessage:
        return StreamMessage(orjson.dumps(document)[:-1] + self._policy.signature(self._model), True)


def error_message(error: LeagueError, retry: float) -> StreamMessage:
    """An error as a message. retry: seconds to wait after NotReady."""
    document: dict[str, Any] = {"code": error.code, "message": error.public_message, "status": status_of(error)}
    if document["status"] >= 500:
        logger.error("%s: %s", error.code, error)
    if document["status"] in (429, 503):
        wait = error.wait if isinstance(error, RateLimited) else 1.0 if document["status"] == 429 else retry
        document["retry_after"] = max(1, ceil(wait))
        if document["status"] == 429:
            return _text(document)._replace(pause=wait)
    return _text(document)


def _parsed(data: bytes) -> dict[str, Any]:
    try:
        return parse_json_object(data)
    except MalformedBody:
        try:
            data.decode()
        except UnicodeDecodeError:
            raise CloseStream(INVALID_PAYLOAD, "a text message is not valid UTF-8") from None
        raise


def _resets(reset: Any, request: DecodedActionRequest) -> NDArray | None:
    """The rows in which an episode starts, if given per row. Raises InvalidInput."""
    if type(reset) is bool:
        return None
    if not request.is_batch or type(reset) is not list:
        raise InvalidInput(f"reset is {json_type(reset)}, expected true or false, or in a batch a list of booleans")
    if len(reset) != len(request.observations) or any(type(flag) is not bool for flag in reset):
        raise InvalidInput(f"reset must have {len(request.observations)} booleans: one per observation")
    return np.array(reset)


def _text(document: dict[str, Any]) -> StreamMessage:
    return StreamMessage(orjson.dumps(document), True)
