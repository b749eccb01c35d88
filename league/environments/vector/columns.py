"""Puts the reports of single environments into the columns of a vectorised one."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from league.environments.adapters import Observation, Report
from league.environments.vector.vector_env import AgentRows
from league.errors import ObservationError
from league.spaces import Leaf


def agent_rows(
    agents: Sequence[str],
    inputs: Sequence[Mapping[str, Leaf]],
    first_alike: Sequence[int],
    reports: Mapping[int, Sequence[Report] | None],
) -> list[AgentRows]:
    """Return the reports of environments in columns, in a block for each observation space.

    Args:
        agents: Names of the agents.
        inputs: ONNX inputs of each agent.
        first_alike: The first agent with the same observations, of each agent.
        reports: Environment → its reports. None counts as no reports.

    Raises:
        ObservationError: An observation does not have the shape of its space.
    """
    blocks: dict[int, list[tuple[int, Report]]] = defaultdict(list)
    for env, env_reports in reports.items():
        for report in env_reports or ():
            blocks[first_alike[report[0]]].append((env, report))
    return [_block(agents, inputs[first], blocks[first]) for first in sorted(blocks)]


def _block(names: Sequence[str], leaves: Mapping[str, Leaf], rows: Sequence[tuple[int, Report]]) -> AgentRows:
    agents, observations, rewards, terminations, truncations = zip(*(report for _, report in rows), strict=True)
    return AgentRows(
        np.array([env for env, _ in rows], dtype=np.int64),
        np.array(agents, dtype=np.int64),
        _stacked(names, leaves, agents, observations),
        np.array(rewards, dtype=np.float64),
        np.array(terminations, dtype=bool),
        np.array(truncations, dtype=bool),
    )


def _stacked(
    names: Sequence[str], leaves: Mapping[str, Leaf], agents: Sequence[int], observations: Sequence[Observation]
) -> dict[str, NDArray]:
    stacked = {}
    for name, leaf in leaves.items():
        try:
            stacked[name] = np.array([row[name] for row in observations], dtype=leaf.dtype)
        except (TypeError, ValueError):
            stacked[name] = np.zeros(0)
        if stacked[name].shape != (len(agents), *leaf.shape):
            shapes = [np.shape(row[name]) for row in observations]
            number = next((i for i, shape in enumerate(shapes) if shape != leaf.shape), 0)
            raise ObservationError(
                f"agent {names[agents[number]]} observes {name} with shape {list(shapes[number])}, but its"
                f" space has {list(leaf.shape)}"
            )
    return stacked
