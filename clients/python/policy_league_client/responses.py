"""Model references of the client, and the responses to action requests."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from policy_league_client.errors import ArtifactCorrupt, UnknownVersion, VersionRetired
from policy_league_client.refs import PolicyRef, parse_version

VERSION_GONE = (VersionRetired, UnknownVersion, ArtifactCorrupt)
"""Errors for a version that is not available any more."""


@dataclass(frozen=True, slots=True)
class Model:
    """A policy of a league at a version: a number, an alias, or None for the current champion."""

    policy: PolicyRef
    version: int | str | None = None

    @property
    def path(self) -> str:
        """Path of the policy's routes."""
        return f"/v1/policies/{self.policy}"

    @property
    def query(self) -> str:
        """Query string that specifies the version."""
        return "" if self.version is None else f"?version={self.version}"

    def at(self, version: int) -> "Model":
        """Return the same policy at a version."""
        return Model(self.policy, version)

    def __str__(self) -> str:
        return str(self.policy) if self.version is None else f"{self.policy}@{self.version}"


@lru_cache(maxsize=1024)  # a client uses few different models
def parse_model(text: str) -> Model:
    """Parse `LEAGUE[.POLICY][@VERSION]`. Raises InvalidReference."""
    policy, at, version = text.partition("@")
    return Model(PolicyRef.parse(policy), parse_version(version) if at else None)


Probabilities = Any
"""Discrete: (n,) float64, sum 1. MultiDiscrete: a list of such arrays. Box: `mean` and `std` in the action's shape."""


@dataclass(frozen=True, slots=True)
class SearchAnalysis:
    """What a search expects in a position.

    Attributes:
        value: Expected return of the agent that must act.
        visits: Simulations through each action.
        line: The expected actions of all agents, from this one on.
    """

    value: float
    visits: list[int]
    line: list[int]


@dataclass(frozen=True, slots=True)
class ActionResponse:
    """An action and its origin.

    Attributes:
        action: The action in the environment's format: an int or an array (float32 or int64).
        version: The version that chose it.
        sha256: Digest of the version's manifest.
        replica: Name of the replica that answered; for a stream, of the replica that it is connected to.
        seed: Seed of the request, with which the action was sampled, unless it is greedy. The same version and seed
            give the same action again. None with `explore=False`.
        probabilities: Action probabilities, if requested; see `Probabilities`.
        state: Recurrent state for the next observation, as an opaque token; None for policies without state.
        simulations: Positions that a search version evaluated besides the current one; None for other versions.
        analysis: What the search expects, if requested.
    """

    action: Any
    version: int
    sha256: str
    replica: str
    seed: int | None = None
    probabilities: Probabilities | None = None
    state: str | None = None
    simulations: int | None = None
    analysis: SearchAnalysis | None = None


@dataclass(frozen=True, slots=True)
class BatchActionResponse:
    """The actions for a batch of k observations, from one version.

    Attributes:
        actions: k actions; see `ActionResponse.action`.
        version: The version that chose them.
        sha256: Digest of the version's manifest.
        replica: See `ActionResponse.replica`.
        seed: One seed for the batch, or one for each observation.
        probabilities: Action probabilities of each observation, if requested.
        state: Recurrent state of each observation.
        simulations: Those of each observation; None unless a search version answered.
        analysis: What the search expects in each position, if requested.
    """

    actions: list[Any]
    version: int
    sha256: str
    replica: str
    seed: int | list[int] | None = None
    probabilities: list[Probabilities] | None = None
    state: list[str] | None = None
    simulations: list[int] | None = None
    analysis: list[SearchAnalysis] | None = None

    def response(self, row: int) -> ActionResponse:
        """Return the response to one observation.

        If the batch has a single seed, its action is reproducible only at the same position in a batch.
        """
        return ActionResponse(
            self.actions[row],
            self.version,
            self.sha256,
            self.replica,
            self.seed[row] if isinstance(self.seed, list) else self.seed,
            None if self.probabilities is None else self.probabilities[row],
            None if self.state is None else self.state[row],
            None if self.simulations is None else self.simulations[row],
            None if self.analysis is None else self.analysis[row],
        )


def parse_action_response(body: Mapping[str, Any], replica: str, seed: int | None) -> ActionResponse:
    """Parse the response to one observation."""
    probabilities, analysis = body.get("probabilities"), body.get("analysis")
    return ActionResponse(
        decode_action(body["action"]),
        body["version"],
        body["sha256"],
        replica,
        seed,
        None if probabilities is None else _decode_probabilities(probabilities),
        body.get("state"),
        body.get("simulations"),
        None if analysis is None else _decode_analysis(analysis),
    )


def parse_batch_action_response(
    body: Mapping[str, Any], replica: str, seed: int | list[int] | None
) -> BatchActionResponse:
    """Parse the response to a batch."""
    probabilities, analyses = body.get("probabilities"), body.get("analysis")
    return BatchActionResponse(
        [decode_action(action) for action in body["actions"]],
        body["version"],
        body["sha256"],
        replica,
        seed,
        None if probabilities is None else [_decode_probabilities(distribution) for distribution in probabilities],
        body.get("state"),
        body.get("simulations"),
        None if analyses is None else [_decode_analysis(analysis) for analysis in analyses],
    )


def decode_action(action: Any) -> Any:
    """Return a JSON action in the environment's format: floats become float32 arrays."""
    if isinstance(action, int):
        return action
    array = np.asarray(action)
    return array.astype(np.float32) if array.dtype.kind == "f" else array


def episode_interrupted(model: Model, steps: int, error: Exception) -> VersionRetired:
    """Return the error for an episode whose version is not available any more."""
    return VersionRetired(f"the episode cannot continue after {steps} actions of {model}: {error}")


def _decode_probabilities(value: Any) -> Probabilities:
    if isinstance(value, dict):
        return {name: np.asarray(part) for name, part in value.items()}
    if value and isinstance(value[0], list):
        return [np.asarray(component) for component in value]
    return np.asarray(value)


def _decode_analysis(document: Mapping[str, Any]) -> SearchAnalysis:
    return SearchAnalysis(document["value"], document["visits"], document["line"])
