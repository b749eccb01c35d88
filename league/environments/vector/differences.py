"""Compares reports of a vectorised environment with those of another, bit for bit."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows

STOCK = "the stock environment"
COLUMNS = ("envs", "agents", "rewards", "terminations", "truncations")


class EnvironmentsDiffer(Exception):
    """An environment reported something else than the other. The message is one line."""


@dataclass(frozen=True, slots=True)
class RowNames:
    """Names a row. seeds, steps: of each copy at the time of the report. other: what it is compared with."""

    agents: Sequence[str]
    seeds: NDArray[np.int64]
    steps: NDArray[np.int64]
    other: str = STOCK

    def text(self, env: int, *agents: int) -> str:
        copy = f"copy {env}, seed {self.seeds[env]}, step {self.steps[env]}"
        return ", ".join([copy, *(self.agents[agent] for agent in agents)])


def check_reports(expected: Sequence[AgentRows], reported: Sequence[AgentRows], where: RowNames) -> None:
    """Raise EnvironmentsDiffer unless both have the same blocks, and all columns of these are equal."""
    if len(reported) != len(expected):
        raise EnvironmentsDiffer(
            f"{len(reported)} AgentRows have rows, expected {len(expected)}: one per observation space"
        )
    for stock, vector in zip(expected, reported, strict=True):
        _check_rows(stock, vector, where)


def check_states(expected: NDArray | None, state: NDArray | None, where: RowNames, envs: NDArray[np.int64]) -> None:
    """Raise EnvironmentsDiffer unless the states of the copies `envs` are equal, or both environments have none."""
    if expected is not None and state is not None:
        _check_column("state", expected, state, where, envs)
    elif expected is not state:
        raise EnvironmentsDiffer(
            "the environment has no state, but the stock environment has one"
            if state is None
            else "the environment has a state, the stock environment has none"
        )


def _check_rows(stock: AgentRows, vector: AgentRows, where: RowNames) -> None:
    if not (np.array_equal(stock.envs, vector.envs) and np.array_equal(stock.agents, vector.agents)):
        pairs = [list(zip(rows.envs.tolist(), rows.agents.tolist(), strict=True)) for rows in (vector, stock)]
        row, (has, should) = next(pair for pair in enumerate(zip_longest(*pairs)) if pair[1][0] != pair[1][1])
        raise EnvironmentsDiffer(
            f"row {row} is {f'of copy {has[0]}, agent {has[1]}' if has else 'missing'}, in {where.other}"
            f" {f'of {where.text(*should)}' if should else 'missing'}"
        )
    if vector.observations.keys() != stock.observations.keys():
        raise EnvironmentsDiffer(
            f"observations are {', '.join(vector.observations)}, in {where.other} {', '.join(stock.observations)}"
        )
    columns = [(name, getattr(stock, name), getattr(vector, name)) for name in COLUMNS]
    observations = [(name, values, vector.observations[name]) for name, values in stock.observations.items()]
    for column, values, vector_values in columns + observations:
        _check_column(column, values, vector_values, where, stock.envs, stock.agents)


def _check_column(column: str, stock: NDArray, vector: NDArray, where: RowNames, *ids: NDArray[np.int64]) -> None:
    """Raise EnvironmentsDiffer unless two arrays (k, …) have the same dtype, shape and bits. ids: the names of rows."""
    if (vector.dtype, vector.shape) == (stock.dtype, stock.shape) and vector.tobytes() == stock.tobytes():
        return
    row, index = 0, []
    values = [f"{array.dtype}{list(array.shape)}" for array in (vector, stock)]
    if values[0] == values[1]:
        bits = [np.ascontiguousarray(array)[..., np.newaxis].view(np.uint8) for array in (vector, stock)]
        row, *index = np.argwhere((bits[0] != bits[1]).any(axis=-1))[0].tolist()
        values = [repr(array[(row, *index)].item()) for array in (vector, stock)]
    name = where.text(*(int(array[row]) for array in ids))
    raise EnvironmentsDiffer(f"{name}: {column}{index or ''} is {values[0]}, in {where.other} {values[1]}")
