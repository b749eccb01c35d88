"""One stream: each message is answered by one message, from a version that stays, with the state that it keeps.

A stream is pinned to a version for its life, or follows an alias. Where a recurrent policy remembers something, a
stream that follows goes to another version only when all its episodes begin anew.
"""

from dataclasses import dataclass
from math import ceil
from time import perf_counter_ns
from typing import Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from league.errors import InvalidInput, InvalidState, LeagueError, RateLimited, Unauthenticated
from league.policies.policy import Actions
from league.refs import CHAMPION
from serve_app.acting import Arrays, act, act_as_asked, generators, is_plain, reply_to
from serve_app.asks import KEYS, Ask, pinned_version, read_ask, read_flag, refuse_unknown
from serve_app.bodies import parse_object
from serve_app.doors import Doors
from serve_app.error_handlers import MalformedBody, logger, status_of
from serve_app.keyring import Key
from serve_app.live import Live
from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.metrics import Metrics
from serve_app.models import Models, policy_ref
from serve_app.observations import kind
from serve_app.settings import ServeSettings
from serve_app.shadow import Shadow
from serve_app.stream_framing import Framing, read_head
from serve_app.tokens import read_state, write_tokens
from serve_app.traffic import Headers, Traffic

OF_STREAMS = frozenset(("reset", "return_state"))
"""Keys that the action route does not have."""
POLICY_VIOLATION = 1008
NOT_UTF8 = 1007
API = "stream"
"""What messages of streams are called in metrics."""
FAULT = {"code": "internal_error", "message": "the server failed; its log says why", "status": 500}


class Message(NamedTuple):
    """What a stream says."""

    data: bytes
    is_text: bool


class StreamEnds(Exception):
    """What was said ends the stream; `code` is a WebSocket's."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.reason = reason[:120]


class Served(NamedTuple):
    """What answers."""

    version: LoadedVersion
    policy: LoadedPolicy
    framing: Framing
    signature: dict[str, Any]
    """What each reply in JSON says of it."""

    @classmethod
    def of(cls, model: str, version: LoadedVersion, policy: LoadedPolicy) -> "Served":
        signature = {"model": model, "version": version.number, "sha256": version.sha256}
        return cls(version, policy, Framing(policy), signature)


@dataclass(frozen=True, slots=True)
class StreamParts:
    """What all streams of a replica share."""

    models: Models
    live: Live
    traffic: Traffic
    shadow: Shadow
    metrics: Metrics
    doors: Doors
    settings: ServeSettings


class Stream:
    """The conversation of one connection: messages are handed in one after the other.

    follows: the alias whose version answers; None: the version that is `served` does.
    headers: of the handshake, whose key may send a stream that follows the champion to its canary.
    """

    def __init__(
        self,
        parts: StreamParts,
        model: str,
        served: tuple[LoadedVersion, LoadedPolicy],
        follows: str | None,
        headers: Headers,
        key: Key | None,
    ) -> None:
        self._parts = parts
        self._model = model
        self._ref = policy_ref(model)
        self._path = f"/v1/policies/{model}/stream"
        self._follows = follows
        self._headers = headers
        self._key = key
        self._served = Served.of(model, *served)
        self._state: Arrays | None = None
        """Recurrent state, a row for each observation of the last message; None where episodes begin."""
        self._is_batch = False

    async def answer(self, data: bytes, is_text: bool) -> Message:
        """The answer to a message, or the error that refuses it. Raises StreamEnds."""
        try:
            self._parts.doors.admit_message(self._key)
            return await (self._answer_text(data) if is_text else self._answer_binary(data))
        except Unauthenticated as error:
            self._parts.metrics.failed(self._path, error.code)
            raise StreamEnds(POLICY_VIOLATION, str(error)) from None
        except LeagueError as error:
            self._parts.metrics.failed(self._path, error.code)
            return refusal(error, self._parts.settings.retry)
        except StreamEnds:
            raise
        except Exception as error:
            logger.error("a message of a stream failed", exc_info=error)
            self._parts.metrics.failed(self._path, str(FAULT["code"]))
            return _text(FAULT)

    def farewell(self) -> Message | None:
        """What a client needs to go on elsewhere: the recurrent state, if there is any."""
        if self._state is None:
            return None
        return _text({"closing": True, "state": self._tokens()} | self._served.signature)

    async def _answer_text(self, data: bytes) -> Message:
        begun = perf_counter_ns()
        document = _parsed(data)
        refuse_unknown(document, KEYS | OF_STREAMS)
        own = document.keys() & OF_STREAMS
        if document.keys() == {"reset"} and read_flag(document, "reset"):
            self._served, self._state = self._current(), None
            return _text({"reset": True} | self._served.signature)
        return_state, reset = read_flag(document, "return_state"), document.get("reset", False)
        for key in own:
            del document[key]
        ask = read_ask(document, self._parts.settings.max_batch)
        if ask.state is not None:
            raise InvalidState("state is an object, expected a token: a stream takes no arrays")
        is_anew = reset is True or ("state" in document and document["state"] is None)
        served, state = await self._memory(ask, is_anew, _resets(reset, ask))
        quotes = data.count(b'"') - 2 * len(own)
        observations = served.policy.reader.read(ask.observations, is_plain(ask, served.policy, quotes))
        answer = await act_as_asked(ask, served.policy, observations, state)
        self._show(served, observations, state, None if ask.explore else answer.actions)
        self._remember(served, answer, ask.is_batch)
        reply = reply_to(ask, answer, observations, served.policy) | served.signature
        if return_state and self._state is not None:
            reply["state"] = self._tokens()
        message = _text(reply)
        self._count(served, len(ask.observations), begun)
        return message

    async def _answer_binary(self, data: bytes) -> Message:
        begun = perf_counter_ns()
        ask = read_head(data, self._parts.settings.max_batch)
        served, state = self._continued(ask.rows, ask.reset, ask.resets)
        observations = served.framing.read(ask)
        rng = generators(ask.seed, ask.rows) if ask.explore else None
        answer = await act(served.policy, observations, state, rng)
        self._show(served, observations, state, None if ask.explore else answer.actions)
        self._remember(served, answer, is_batch=ask.rows > 1)
        message = Message(served.framing.write(answer.actions, served.version.number), False)
        self._count(served, ask.rows, begun)
        return message

    async def _memory(self, ask: Ask, is_anew: bool, resets: NDArray | None) -> tuple[Served, Arrays | None]:
        """What answers, and with which recurrent state. Raises InvalidState and what `Models.find` raises."""
        if ask.tokens is None or not any(ask.tokens):
            return self._continued(len(ask.observations), is_anew or ask.tokens is not None, resets)
        if is_anew or resets is not None:
            raise InvalidState("reset and state contradict each other: an episode begins, or goes on")
        if not self._served.policy.state:
            raise InvalidState("state must be null: this policy is not recurrent")
        number = pinned_version(ask, self._model, self._follows or str(self._served.version.number))
        served = self._served
        if int(number) != served.version.number:
            served = Served.of(self._model, *await self._parts.models.find(self._model, number))
        model = served.version.model(served.policy)
        return served, read_state(ask.tokens, model, served.version.sha256, served.policy.state)

    def _continued(self, rows: int, is_anew: bool, resets: NDArray | None) -> tuple[Served, Arrays | None]:
        if self._state is None or is_anew or (resets is not None and resets.all()):
            return self._current(), None
        held = len(next(iter(self._state.values())))
        if held != rows:
            raise InvalidState(f"the last message was of {held} observations, this one is of {rows}: it needs a reset")
        if resets is None or not resets.any():
            return self._served, self._state
        state = {name: array.copy() for name, array in self._state.items()}
        for array in state.values():
            array[resets] = 0
        return self._served, state

    def _current(self) -> Served:
        """What answers where no episode is bound to a version."""
        if self._follows is None:
            return self._served
        version = self._parts.live.get(self._ref.league, self._follows) or self._served.version
        if self._follows == CHAMPION and self._parts.traffic.canaries:
            version = self._parts.traffic.answering(version, self._headers)
        if version is self._served.version:
            return self._served
        return Served.of(self._model, version, version.policy(self._ref.policy))

    def _show(self, served: Served, observations: Arrays, state: Arrays | None, actions: NDArray | None) -> None:
        show = self._parts.shadow.of(self._model, served.version)
        if show is not None:
            show(observations, state, actions)

    def _count(self, served: Served, rows: int, begun: int) -> None:
        self._parts.metrics.answered(API, self._model, served.version, rows, perf_counter_ns() - begun)

    def _remember(self, served: Served, answer: Actions, is_batch: bool) -> None:
        self._served, self._state, self._is_batch = served, answer.state, is_batch

    def _tokens(self) -> str | list[str]:
        assert self._state is not None
        version, policy, *_ = self._served
        tokens = write_tokens(version.model(policy), version.number, version.sha256, self._state)
        return tokens if self._is_batch else tokens[0]


def refusal(error: LeagueError, retry: float) -> Message:
    """An error as a message. retry: seconds after which what is not ready may be."""
    document: dict[str, Any] = {"code": error.code, "message": str(error), "status": status_of(error)}
    if document["status"] >= 500:
        logger.error("%s: %s", error.code, error)
    if document["status"] in (429, 503):
        wait = error.wait if isinstance(error, RateLimited) else 1.0 if document["status"] == 429 else retry
        document["retry_after"] = max(1, ceil(wait))
    return _text(document)


def _parsed(data: bytes) -> dict[str, Any]:
    try:
        return parse_object(data)
    except MalformedBody:
        try:
            data.decode()
        except UnicodeDecodeError:
            raise StreamEnds(NOT_UTF8, "a text is not UTF-8") from None
        raise


def _resets(reset: Any, ask: Ask) -> NDArray | None:
    """Where an episode begins, if that is said one by one. Raises InvalidInput."""
    if type(reset) is bool:
        return None
    if not ask.is_batch or type(reset) is not list:
        raise InvalidInput(f"reset is {kind(reset)}, expected true or false, or in a batch a list of such")
    if len(reset) != len(ask.observations) or any(type(each) is not bool for each in reset):
        raise InvalidInput(f"reset must hold {len(ask.observations)} of true or false: one for each observation")
    return np.array(reset)


def _text(document: dict[str, Any]) -> Message:
    return Message(orjson.dumps(document), True)
