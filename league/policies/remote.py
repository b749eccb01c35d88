"""A policy that a server answers for: the client of `POST /v1/policies/{model}/action`."""

import random
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import httpx
import numpy as np
import orjson
from numpy.typing import NDArray

from league import errors
from league.errors import InvalidInput, LeagueError, RemoteError
from league.policies.policy import Actions, Arrays
from league.refs import PolicyRef, check_slug
from league.spaces import ACTION_MASK

ATTEMPTS = 6
"""How often a call is made before it counts as failed."""
BACK_OFF = 0.02
"""Seconds before the second attempt; doubled before each further one, and varied so that clients spread."""
TRANSIENT = (429, 502, 503, 504)
"""Statuses after which another attempt may succeed."""
BY_CODE = {
    error.code: error for error in vars(errors).values() if isinstance(error, type) and issubclass(error, LeagueError)
}


class RemotePolicy:
    """Acts as a served policy does. Connections are kept; may be called by several threads.

    base_url: of the server, `http://127.0.0.1:8000`.
    model: `{league}`, or `{league}.{policy}` where a version has several policies.
    version: a number or an alias; None is the champion of each moment.
    timeout: seconds of one attempt. To act changes nothing, so an attempt that failed for want of a server is repeated.
    """

    def __init__(self, base_url: str, model: str, version: int | str | None = None, timeout: float = 5.0) -> None:
        PolicyRef.parse(model)
        if isinstance(version, str):
            check_slug("version", version)
        self._url = f"{_base(base_url)}/v1/policies/{model}/action"
        self._query = {} if version is None else {"version": str(version)}
        self._http = httpx.Client(timeout=timeout, headers={"content-type": "application/json"})

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        """Act on a batch; see `Policy.act`. The inputs of the action distribution stay on the server.

        Raises the LeagueError that the server answers, InvalidInput for another refusal, or RemoteError if it cannot
        be reached or fails.
        """
        reply = self.post(_request(observations, state, explore, rng))
        new_state = {name: np.asarray(rows, np.float32) for name, rows in reply.get("state", {}).items()}
        return Actions(_actions(reply["actions"]), new_state or None)

    def post(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request's body as the route takes it, arrays allowed, and return the reply.

        Raises what `act` does.
        """
        try:
            body = orjson.dumps(document, option=orjson.OPT_SERIALIZE_NUMPY)
        except orjson.JSONEncodeError as error:
            raise InvalidInput(f"the observations cannot be sent: {error}") from error
        pause = BACK_OFF
        for _ in range(ATTEMPTS - 1):
            reply = self._attempt(body)
            if isinstance(reply, httpx.Response) and not _is_transient(reply):
                return _answer(reply)
            time.sleep(pause * random.uniform(0.5, 1.5))
            pause *= 2
        reply = self._attempt(body)
        if isinstance(reply, httpx.Response):
            return _answer(reply)
        raise RemoteError(f"{self._url} cannot be reached: {reply or type(reply).__name__}") from reply

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _attempt(self, body: bytes) -> httpx.Response | httpx.TransportError:
        try:
            return self._http.post(self._url, content=body, params=self._query)
        except httpx.TransportError as error:
            return error


def _base(url: str) -> str:
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL:
        parsed = httpx.URL()
    if parsed.scheme not in ("http", "https") or not parsed.host:
        raise InvalidInput(f"{url!r} is no address of a server: expected something like http://127.0.0.1:8000")
    return url.rstrip("/")


def _request(
    observations: Arrays, state: Arrays | None, explore: bool, rng: Sequence[np.random.Generator] | None
) -> dict[str, Any]:
    rows = len(next(iter(observations.values())))
    document: dict[str, Any] = {"observations": [_observation(observations, row) for row in range(rows)]}
    # As arrays: rows of matches come and go, and numbers must stay what they are to the last bit.
    document["state"] = {name: np.ascontiguousarray(array) for name, array in (state or {}).items()}
    if explore:
        if rng is None or len(rng) != rows:
            raise InvalidInput(f"exploring {rows} rows needs rng, one generator per row")
        document |= {"explore": True, "seed": [int(generator.integers(2**63)) for generator in rng]}
    return document


def _observation(observations: Arrays, row: int) -> Any:
    """One row as the environment gives it: a Dict's leaves go back to where their names say."""
    if observations.keys() == {"observation"}:
        return _contiguous(observations["observation"], row)
    nested: dict[str, Any] = {}
    for name, array in observations.items():
        *outer, key = name.split(".") if ACTION_MASK in observations else name.split(".")[1:]
        place = nested
        for part in outer:
            place = place.setdefault(part, {})
        place[key] = _contiguous(array, row)
    return nested


def _contiguous(array: NDArray, row: int) -> Any:
    """What orjson takes: a C-contiguous array, or a number."""
    return np.ascontiguousarray(array[row]) if array.ndim > 1 else array[row].item()


def _actions(actions: list[Any]) -> NDArray:
    array = np.array(actions)
    return array.astype(np.float32) if array.dtype.kind == "f" else array


def _is_transient(reply: httpx.Response) -> bool:
    # HAProxy answers 500 in its own words when no replica took the request.
    return reply.status_code in TRANSIENT or (reply.status_code >= 500 and _told(reply) is None)


def _answer(reply: httpx.Response) -> dict[str, Any]:
    told = _told(reply)
    if reply.status_code == 200 and told is not None:
        return told
    if told is None or "code" not in told:
        raise RemoteError(f"{reply.url} answered {reply.status_code}: {reply.text[:200]}")
    otherwise = InvalidInput if reply.status_code < 500 else RemoteError
    raise BY_CODE.get(told["code"], otherwise)(told["message"])


def _told(reply: httpx.Response) -> dict[str, Any] | None:
    try:
        document = orjson.loads(reply.content)
    except orjson.JSONDecodeError:
        return None
    return document if isinstance(document, dict) else None
