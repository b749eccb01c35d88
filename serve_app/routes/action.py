"""POST /v1/policies/{model}/action: observations in, actions out. The hot path: no framework between the bytes.

    request  {"observation": …}  or  {"observations": [ … ]};  besides "state", "explore", "seed"
    reply    {"action": …}       or  {"actions": [ … ]};       besides "model", "version", "sha256" and, if any, "state"

`seed` is an integer, or one for each observation of a batch. An observation explored with a seed of its own gets the
same action in every batch; in a batch with one seed, so does an observation at the same place.
`state` is null or the `state` of an earlier reply: name → nested lists, one row for each observation.
`sha256` is the digest of the version's manifest.json, which holds the digests of all its files.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
import orjson
from numpy.typing import NDArray
from starlette.types import Receive, Scope, Send

from league.errors import BodyTooLarge, InvalidInput, ObservationError, Overloaded
from league.policies.policy import Actions
from league.refs import CHAMPION
from league.seeds import generator
from serve_app.bodies import parse_object, read_body
from serve_app.loading import LoadedPolicy
from serve_app.models import Models
from serve_app.observations import kind, read_state, refuse_strings
from serve_app.settings import ServeSettings

KEYS = frozenset(("observation", "observations", "state", "explore", "seed"))
REPLICA = b"x-league-replica"


@dataclass(frozen=True, slots=True)
class Ask:
    """A request, checked as far as that goes without its policy."""

    observations: list[Any]
    is_batch: bool
    state: Any
    explore: bool
    seed: int | list[int] | None
    document: dict[str, Any]
    quotes: int
    """Quotation marks in the body: two for each string, keys included."""


class ActionRoute:
    """The endpoint, an ASGI application of its own."""

    def __init__(self, models: Models, settings: ServeSettings, replica: str) -> None:
        self._models = models
        self._settings = settings
        self._replica = (REPLICA, replica.encode())
        self.in_flight = 0
        """Requests that were begun and not answered yet."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a POST. Raises LeagueError."""
        if self.in_flight >= self._settings.max_in_flight:
            raise Overloaded(f"{self.in_flight} requests are in progress here already")
        self.in_flight += 1
        try:
            await self._answer(scope, receive, send)
        finally:
            self.in_flight -= 1

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        body = await read_body(scope, receive, self._settings.max_body)
        model = scope["path_params"]["model"]
        version, policy = await self._models.find(model, _version(scope["query_string"]))
        ask = read_ask(body, self._settings.max_batch)
        reply = await _reply(ask, policy) | {"model": model, "version": version.number, "sha256": version.sha256}
        await _send(send, orjson.dumps(reply), self._replica)


def read_ask(body: bytes, max_batch: int) -> Ask:
    """Read a request's body. Raises MalformedBody, BodyTooLarge or InvalidInput."""
    document = parse_object(body)
    if not document.keys() <= KEYS:
        unknown = min(document.keys() - KEYS)
        raise InvalidInput(f"the body has the unknown key {unknown[:64]!r}, expected {', '.join(sorted(KEYS))}")
    is_batch = "observations" in document
    if is_batch == ("observation" in document):
        both = "both observation and observations" if is_batch else "neither observation nor observations"
        raise InvalidInput(f"the body has {both}, expected one of them")
    observations = document["observations"] if is_batch else [document["observation"]]
    if is_batch:
        _check_batch(observations, max_batch)
    explore, seed = document.get("explore", False), document.get("seed")
    if type(explore) is not bool:
        raise InvalidInput(f"explore is {kind(explore)}, expected true or false")
    _check_seed(seed, len(observations) if is_batch else None)
    state = document.get("state")
    return Ask(observations, is_batch, state, explore, seed, document, body.count(b'"'))


async def _reply(ask: Ask, policy: LoadedPolicy) -> dict[str, Any]:
    rows = len(ask.observations)
    observations, state = _arrays(ask, policy)
    rng = _generators(ask.seed, rows) if ask.explore else None

    def act() -> Actions:
        return policy.policy.act(observations, state=state, explore=ask.explore, rng=rng)

    answer = act() if rows <= policy.inline_rows else await asyncio.to_thread(act)
    actions = answer.actions.tolist()
    reply = {"actions": actions} if ask.is_batch else {"action": actions[0]}
    if answer.state is not None:
        reply["state"] = {name: array.tolist() for name, array in answer.state.items()}
    return reply


def _arrays(ask: Ask, policy: LoadedPolicy) -> tuple[dict[str, NDArray], dict[str, NDArray] | None]:
    """The graph's inputs. Raises ObservationError or IllegalMask."""
    reader = policy.reader
    keys = len(ask.document) + len(ask.observations) * reader.keys
    if ask.quotes != 2 * keys:
        # There are more strings than keys, unless a key is wrong, which is told below.
        refuse_strings(ask.document)
    observations = reader.read(ask.observations)
    if ask.state is None:
        return observations, None
    if not policy.state:
        raise ObservationError("state must be null: this policy is not recurrent")
    return observations, read_state(ask.state, policy.state, len(ask.observations))


def _generators(seed: int | list[int] | None, rows: int) -> Sequence[np.random.Generator]:
    """One per row, so that an answer does not depend on the batch that it was asked for in."""
    if seed is None:
        return [np.random.default_rng() for _ in range(rows)]
    if isinstance(seed, list):
        return [generator(own, 0) for own in seed]
    return [generator(seed, row) for row in range(rows)]


def _check_seed(seed: Any, batch: int | None) -> None:
    if seed is None:
        return
    if batch is not None and type(seed) is list and len(seed) != batch:
        raise InvalidInput(f"seed holds {len(seed)} integers, expected {batch}: one per observation")
    seeds = seed if batch is not None and type(seed) is list else [seed]
    if any(type(each) is not int or not 0 <= each < 2**63 for each in seeds):
        raise InvalidInput("seed must be null or an integer from 0 to 2^63 - 1, or in a batch a list of such integers")


def _check_batch(observations: Any, max_batch: int) -> None:
    if type(observations) is not list:
        raise InvalidInput(f"observations is {kind(observations)}, expected a list of observations")
    if not observations:
        raise InvalidInput("observations is empty, expected at least one")
    if len(observations) > max_batch:
        raise BodyTooLarge(f"observations holds {len(observations)}, expected at most {max_batch}")


def _version(query: bytes) -> str:
    if not query:
        return CHAMPION
    given = dict(parse_qsl(query.decode("latin-1"), keep_blank_values=True, max_num_fields=16))
    return given.get("version", CHAMPION)


async def _send(send: Send, body: bytes, replica: tuple[bytes, bytes]) -> None:
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body)), replica]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})
