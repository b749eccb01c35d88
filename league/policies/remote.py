"""A policy that a server answers for, as matches and programs use any other: `Policy` on the client."""

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from league.client.calls import Call, Document
from league.client.client import Client
from league.client.encoding import to_json
from league.client.models import Model
from league.client.questions import BatchQuestion
from league.errors import InvalidInput
from league.policies.policy import Actions, Arrays
from league.refs import PolicyRef, check_slug
from league.spaces import ACTION_MASK


class RemotePolicy:
    """Acts as a served policy does. Connections are kept; may be called by several threads.

    base_url: of the server, `http://127.0.0.1:8000`.
    model: `{league}`, or `{league}.{policy}` where a version has several policies.
    version: a number or an alias; None is the champion of each moment.
    timeout: seconds of one attempt.
    options: what else a `Client` takes.
    """

    def __init__(
        self, base_url: str, model: str, version: int | str | None = None, timeout: float = 5.0, **options: Any
    ) -> None:
        if isinstance(version, str):
            check_slug("version", version)
        self._model = Model(PolicyRef.parse(model), version)
        self._client = Client(base_url, timeout=timeout, **options)

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
        rows = len(next(iter(observations.values())))
        question = BatchQuestion.about(
            [_observation(observations, row) for row in range(rows)],
            self._client.encoding,
            explore=explore,
            seed=_seeds(rng, rows) if explore else None,
        )
        # As arrays: rows of matches come and go, and numbers must stay what they are to the last bit.
        given = {name: np.ascontiguousarray(array) for name, array in (state or {}).items()}
        path = f"{self._model.path}/action{self._model.query}"
        return self._client.send(Call(path, _read, to_json(question.document | {"state": given})))

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _read(reply: Document, _: str) -> Actions:
    state = {name: np.asarray(rows, np.float32) for name, rows in reply.get("state", {}).items()}
    actions = np.array(reply["actions"])
    return Actions(actions.astype(np.float32) if actions.dtype.kind == "f" else actions, state or None)


def _seeds(rng: Sequence[np.random.Generator] | None, rows: int) -> list[int]:
    if rng is None or len(rng) != rows:
        raise InvalidInput(f"exploring {rows} rows needs rng, one generator per row")
    return [int(generator.integers(2**63)) for generator in rng]


def _observation(observations: Arrays, row: int) -> Any:
    """One row as the environment gives it: a Dict's leaves go back to where their names say."""
    if observations.keys() == {"observation"}:
        return observations["observation"][row]
    nested: dict[str, Any] = {}
    for name, array in observations.items():
        *outer, key = name.split(".") if ACTION_MASK in observations else name.split(".")[1:]
        place = nested
        for part in outer:
            place = place.setdefault(part, {})
        place[key] = array[row]
    return nested
