"""A policy served by a policy server, with the interface `Policy`."""

from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from league.client import Client
from league.client.calls import ApiCall
from league.client.requests import BatchActionRequest, JsonObject, to_json
from league.client.responses import Model
from league.errors import InvalidInput
from league.policies.policy import Actions, Arrays
from league.refs import PolicyRef, check_slug
from league.spaces import ACTION_MASK, Space
from league.spaces.arrays import nested


class RemotePolicy:
    """A served policy. Keeps its connections open and is thread-safe.

    Args:
        base_url: Base URL of the server, `http://127.0.0.1:8000`.
        model: `LEAGUE`, or `LEAGUE.POLICY` if a version has several policies.
        version: A number or an alias; None for the current champion.
        timeout: Seconds allowed for one attempt.
        observation: Observation space of the policy. None: dots in the names of arrays separate the keys of nested
            Dicts, and beside a mask there is one more key, `observation`.
        options: Further arguments of `league.client.Client`.
    """

    def __init__(
        self,
        base_url: str,
        model: str,
        version: int | str | None = None,
        timeout: float = 5.0,
        observation: Space | None = None,
        **options: Any,
    ) -> None:
        if isinstance(version, str):
            check_slug("version", version)
        self._model = Model(PolicyRef.parse(model), version)
        self._space = observation
        self._client = Client(base_url, timeout=timeout, **options)

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        """Choose actions for a batch; see `Policy.act`. `dist_inputs` are not transferred.

        Raises:
            LeagueError: The error in the server's response.
            RemoteError: The server is unreachable or failed.
        """
        rows = len(next(iter(observations.values())))
        # Explicit in both cases, because the default of the server depends on the league.
        request = BatchActionRequest.build(
            [self._observation({name: array[row] for name, array in observations.items()}) for row in range(rows)],
            self._client.encoding,
            explore=explore,
            seed=_seeds(rng, rows) if explore else None,
        )
        # As arrays, which preserve every bit; state tokens do not allow changing the rows of a batch.
        state_arrays = {name: np.ascontiguousarray(array) for name, array in (state or {}).items()}
        path = f"{self._model.path}/action{self._model.query}"
        return self._client.send(ApiCall(path, _read, to_json(request.body | {"state": state_arrays})))

    def _observation(self, arrays: Arrays) -> Any:
        return _by_names(arrays) if self._space is None else nested(self._space, arrays)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _read(response: JsonObject, _: str) -> Actions:
    state = {name: np.asarray(rows, np.float32) for name, rows in response.get("state", {}).items()}
    actions = np.array(response["actions"])
    return Actions(actions.astype(np.float32) if actions.dtype.kind == "f" else actions, state or None)


def _seeds(rng: Sequence[np.random.Generator] | None, rows: int) -> list[int]:
    if rng is None or len(rng) != rows:
        raise InvalidInput(f"exploring {rows} rows needs rng, one generator per row")
    return [int(generator.integers(2**63)) for generator in rng]


def _by_names(arrays: Arrays) -> Any:
    """One observation in the environment's format: leaves of a Dict are nested again by their names."""
    if arrays.keys() == {"observation"}:
        return arrays["observation"]
    value: dict[str, Any] = {}
    for name, array in arrays.items():
        *outer, key = name.split(".") if ACTION_MASK in arrays else name.split(".")[1:]
        place = value
        for part in outer:
            place = place.setdefault(part, {})
        place[key] = array
    return value
