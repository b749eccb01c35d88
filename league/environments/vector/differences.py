"""Compares reports of a vectorised environment with those of another, bit for bit."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows

STOCK = "the stock environment"


class EnvironmentsDiffer(Exception):
    """An environment reported something else than the other. The message is one line."""


@dataclass(frozen=True, slots=True)
class RowNames:
    """Names a row. seeds, steps: of each copy at the time of the report. other: what it is compared with."""

    agents: Sequence[str]
    seeds: NDArray[np.int64]
    steps: NDArray[np.int64]
    other: str = STOCK

    def text(self, env: int, agent: int | None = None) -> str:
        copy = f"copy {env}, seed {self.seeds[env]}, step {self.steps[env]}"
        return copy if agent is None else f"{copy}, {self.agents[agent]}"


def check_rows(stock: AgentRows, vector: AgentRows, where: RowNames) -> None:
    """Raise EnvironmentsDiffer unless all columns are equal."""
    if not (np.array_equal(stock.envs, vector.envs) and np.array_equal(stock.agents, vector.agents)):
        stock_pairs, vector_pairs = (
            list(zip(rows.envs.tolist(), rows.agents.tolist(), strict=True)) for rows in (stock, vector)
        )
        differing = (row for row, pair in enumerate(stock_pairs) if vector_pairs[row : row + 1] != [pair])
        row = next(differing, len(stock_pairs))
        has = f"of copy {vector_pairs[row][0]}, agent {vector_pairs[row][1]}" if row < len(vector_pairs) else "missing"
        should = f"of {where.text(*stock_pairs[row])}" if row < len(stock_pairs) else "missing"
        raise EnvironmentsDiffer(f"row {row} is {has}, in {where.other} {should}")
    if vector.observations.keys() != stock.observations.keys():
        raise EnvironmentsDiffer(
            f"observations are {', '.join(vector.observations)}, in {where.other} {', '.join(stock.observations)}"
        )

    def name(row: int) -> str:
        return where.text(int(stock.envs[row]), int(stock.agents[row]))

    for column in ("envs", "agents", "rewards", "terminations", "truncations"):
        check_column(column, getattr(stock, column), getattr(vector, column), name, where.other)
    for column, values in stock.observations.items():
        check_column(column, values, vector.observations[column], name, where.other)


def check_column(column: str, stock: NDArray, vector: NDArray, name: Callable[[int], str], other: str = STOCK) -> None:
    """Raise EnvironmentsDiffer unless two arrays (k, …) have the same dtype, shape and bits."""
    if (vector.dtype, vector.shape) != (stock.dtype, stock.shape):
        raise EnvironmentsDiffer(
            f"{name(0)}: {column} is {vector.dtype}{list(vector.shape)}, in {other} {stock.dtype}{list(stock.shape)}"
        )
    if stock.tobytes() == vector.tobytes():
        return
    differs = (_bits(stock) != _bits(vector)).any(axis=-1)
    row, *index = np.argwhere(differs)[0].tolist()
    vector_value, stock_value = (array[(row, *index)].item() for array in (vector, stock))
    raise EnvironmentsDiffer(f"{name(row)}: {column}{index or ''} is {vector_value!r}, in {other} {stock_value!r}")


def _bits(array: NDArray) -> NDArray[np.uint8]:
    """The bytes of each element, (…, itemsize)."""
    return np.ascontiguousarray(array)[..., np.newaxis].view(np.uint8)
