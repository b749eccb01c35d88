"""POST /v1/policies/{model}/action: observations in, actions out. The hot path: no framework between the bytes.

    request  {"observation": …}  or  {"observations": [ … ]};  besides "state", "explore", "seed", "probabilities"
    reply    {"action": …}       or  {"actions": [ … ]};       besides "model", "version", "sha256" and what is wanted

`seed` is an integer, or one for each observation of a batch. An observation explored with a seed of its own gets the
same action in every batch; in a batch with one seed, so does an observation at the same place.
`state` is null or the `state` of an earlier reply: a token for each observation, whose version answers; or arrays, name
→ nested lists, one row for each observation, which are answered with arrays.
`sha256` is the digest of the version's manifest.json, which holds the digests of all its files.
"""

from time import perf_counter_ns
from typing import Any
from urllib.parse import parse_qsl

import orjson
from starlette.types import ASGIApp, Receive, Scope, Send

from league.errors import InvalidInput, Overloaded
from league.refs import CHAMPION
from serve_app.access_log import LINE, answered_by
from serve_app.acting import act_as_asked, is_plain, read_given_state, reply_to, written_state
from serve_app.asks import KEYS, Ask, pinned_version, read_ask, refuse_unknown
from serve_app.bodies import parse_object, read_body
from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.metrics import Metrics
from serve_app.models import Models
from serve_app.settings import ServeSettings
from serve_app.shadow import Shadow, Show

REPLICA = b"x-league-replica"
BEGINNING, ENDING = "/v1/policies/", "/action"
API = "action"
"""What this route is called in metrics."""
MOST_PARAMETERS = 16
"""In a query."""


class ActionRoute:
    """The endpoint, an ASGI application of its own."""

    def __init__(self, models: Models, shadow: Shadow, metrics: Metrics, settings: ServeSettings, replica: str) -> None:
        self._models = models
        self._shadow = shadow
        self._metrics = metrics
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
        begun = perf_counter_ns()
        body = await read_body(scope, receive, self._settings.max_body)
        document = parse_object(body)
        refuse_unknown(document, KEYS)
        ask = read_ask(document, self._settings.max_batch)
        model = scope["path_params"]["model"]
        asked = pinned_version(ask, model, query(scope).get("version", CHAMPION))
        version, policy = await self._models.find(model, asked, scope["headers"])
        reply = await _reply(ask, body.count(b'"'), version, policy, self._shadow.of(model, version))
        reply |= {"model": model, "version": version.number, "sha256": version.sha256}
        if LINE in scope:
            answered_by(scope, model, version.number)
        await _send(send, orjson.dumps(reply), self._replica)
        self._metrics.answered(API, model, version, len(ask.observations), perf_counter_ns() - begun)


class Shortcut:
    """Requests for actions go to their route at once; the others are looked up among all routes."""

    def __init__(self, application: ASGIApp, action: ActionRoute) -> None:
        self._application = application
        self._action = action

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Raises LeagueError."""
        path = scope["path"] if scope["type"] == "http" else ""
        if path.startswith(BEGINNING) and path.endswith(ENDING) and scope["method"] == "POST":
            model = path[len(BEGINNING) : -len(ENDING)]
            if model and "/" not in model:
                scope["path_params"] = {"model": model}
                await self._action(scope, receive, send)
                return
        await self._application(scope, receive, send)


def query(scope: Scope) -> dict[str, str]:
    """What stands behind the question mark. Raises InvalidInput."""
    text: bytes = scope["query_string"]
    if not text:
        return {}
    try:
        return dict(parse_qsl(text.decode("latin-1"), keep_blank_values=True, max_num_fields=MOST_PARAMETERS))
    except ValueError:
        raise InvalidInput(f"the query has more than {MOST_PARAMETERS} parameters") from None


async def _reply(
    ask: Ask, quotes: int, version: LoadedVersion, policy: LoadedPolicy, show: Show | None
) -> dict[str, Any]:
    plain = is_plain(ask, policy, quotes)
    observations = policy.reader.read(ask.observations, plain)
    state = read_given_state(ask, version, policy, not plain)
    answer = await act_as_asked(ask, policy, observations, state)
    if show is not None:
        show(observations, state, None if ask.explore else answer.actions)
    reply = reply_to(ask, answer, observations, policy)
    if answer.state is not None:
        if ask.state is not None:
            reply["state"] = {name: array.tolist() for name, array in answer.state.items()}
        else:
            tokens = written_state(answer, version, policy)
            reply["state"] = tokens if ask.is_batch else tokens[0]
    return reply


async def _send(send: Send, body: bytes, replica: tuple[bytes, bytes]) -> None:
    headers = [(b"content-type", b"application/json"), (b"content-length", b"%d" % len(body)), replica]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": body})
