"""Compares reports of a vectorised environment with those of its stock environment, bit for bit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows


class EnvironmentsDiffer(Exception):
    """A vectorised environment reported something else than the stock environment. The message is one line."""


@dataclass(frozen=True, slots=True)
class RowNames:
    """Names a row. seeds, steps: of each copy at the time of the report."""

    agents: Sequence[str]
    seeds: NDArray[np.int64]
    steps: NDArray[np.int64]

    def text(self, env: int, agent: int | None = None) -> str:
        copy = f"copy {env}, seed {self.seeds[env]}, step {self.steps[env]}"
        return copy if agent is None else f"{copy}, {self.agents[agent]}"


def check_rows(stock: AgentRows, vector: AgentRows, where: RowNames) -> None:
    """Raise EnvironmentsDiffer unless all columns are equal."""
    if not (np.array_equal(stock.envs, vector.envs) and np.array_equal(stock.agents, vector.agents)):
        raise _other_rows(stock, vector, where)
    if vector.observations.keys() != stock.observations.keys():
        raise EnvironmentsDiffer(
            f"observations are {', '.join(vector.observations)}, in the stock environment"
            f" {', '.join(stock.observations)}"
        )

    def name(row: int) -> str:
        return where.text(int(stock.envs[row]), int(stock.agents[row]))

    for column in ("envs", "agents", "rewards", "terminations", "truncations"):
        check_column(column, getattr(stock, column), getattr(vector, column), name)
    for column, values in stock.observations.items():
        check_column(column, values, vector.observations[column], name)


def _other_rows(stock: AgentRows, vector: AgentRows, where: RowNames) -> EnvironmentsDiffer:
    """The first row of another copy or agent."""
    stock_pairs, vector_pairs = (
        list(zip(rows.envs.tolist(), rows.agents.tolist(), strict=True)) for rows in (stock, vector)
    )
    row = next((row for row, pair in enumerate(stock_pairs) if vector_pairs[row : row + 1] != [pair]), len(stock_pairs))
    has = f"of copy {vector_pairs[row][0]}, agent {vector_pairs[row][1]}" if row < len(vector_pairs) else "missing"
    should = f"of {where.text(*stock_pairs[row])}" if row < len(stock_pairs) else "missing"
    return EnvironmentsDiffer(f"row {row} is {has}, in the stock environment {should}")


def check_column(column: str, stock: NDArray, vector: NDArray, name: Callable[[int], str]) -> None:
    """Raise EnvironmentsDiffer unless two arrays (k, …) have the same dtype, shape and bits."""
    if (vector.dtype, vector.shape) != (stock.dtype, stock.shape):
        raise EnvironmentsDiffer(
            f"{name(0)}: {column} is {vector.dtype}{list(vector.shape)}, in the stock environment"
            f" {stock.dtype}{list(stock.shape)}"
        )
    if stock.tobytes() == vector.tobytes():
        return
    differs = (_bits(stock) != _bits(vector)).any(axis=-1)
    row, *index = np.argwhere(differs)[0].tolist()
    vector_value, stock_value = (array[(row, *index)].item() for array in (vector, stock))
    raise EnvironmentsDiffer(
        f"{name(row)}: {column}{index or ''} is {vector_value!r}, in the stock environment {stock_value!r}"
    )


def _bits(array: NDArray) -> NDArray[np.uint8]:
    """The bytes of each element, (…, itemsize)."""
    return np.ascontiguousarray(array)[..., np.newaxis].view(np.uint8)
