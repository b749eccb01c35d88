"""Recorded decisions become the chunks that a learner takes."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from league.errors import ConfigError
from league.interface import AgentInterface
from league.spaces import Box, DictSpace, Discrete
from training.sampling.recorded_games import RecordedGames

MASK = Box(dtype="int8", shape=(3,), low=0, high=1)
NUMBERS = Box(dtype="float32", shape=(2,), low=None, high=None)
SPACES = AgentInterface(
    observation=DictSpace(spaces={"observation": NUMBERS, "action_mask": MASK}), action=Discrete(n=3, start=5)
)


def row(match: str, game: int, agent: str, step: int, **values: Any) -> dict[str, Any]:
    """A decision, whose observation is the step."""
    return {
        "match": match,
        "game": game,
        "agent": agent,
        "step": step,
        "observation": [float(step), 0.0],
        "action_mask": [1, 1, 0],
        "action": 5 + step % 2,
        "reward": float(step),
        "terminated": False,
        "is_opening": False,
    } | values


ROWS = [
    row("a", 0, "red", 1, is_opening=True),
    row("a", 0, "red", 3),
    row("a", 0, "red", 5, terminated=True),
    row("a", 0, "blue", 2),
    row("a", 0, "blue", 4, terminated=True),
    row("a", 1, "red", 1),
    row("a", 1, "red", 2),
    row("b", 0, "blue", 7),
]
"""The agents of the first game terminated. In the second one, red was truncated, and in the last, blue after a single
decision."""


def written(directory: Path, rows: list[dict[str, Any]]) -> Path:
    path = directory / "shared.parquet"
    pq.write_table(pa.Table.from_pylist(rows), path)
    return path


def test_each_agent_of_each_game_is_a_chunk(tmp_path: Path) -> None:
    rows = [ROWS[number] for number in np.random.default_rng(0).permutation(len(ROWS))]
    games = RecordedGames.read(written(tmp_path, rows), "shared", SPACES)
    chunks = games.chunks("c", np.array([2, 0, 1]))
    steps = chunks.observations["observation"][:, 0].tolist()
    assert steps == [1, 2, 2, 4, 4, 3, 5, 5]  # red of the second game, blue and red of the first one
    assert chunks.lengths.tolist() == [1, 2, 2]
    assert chunks.terminated.tolist() == [False, True, True]
    assert chunks.truncated.tolist() == [True, False, False]
    assert chunks.actions.tolist() == [1, 0, 0, 1, 1]
    assert chunks.rewards.tolist() == [1, 2, 4, 3, 5]


def test_rows_that_do_not_fit_are_refused(tmp_path: Path, subtests: pytest.Subtests) -> None:
    rows: list[tuple[dict[str, Any], str]] = [
        ({"action": 7}, "1 actions are not legal by their action_mask"),
        ({"action": 8}, "action must be between 5 and 7"),
        ({"observation": [1.0, 2.0, 3.0]}, "observation has 15 numbers in 7 rows, expected 2 in each"),
        ({"observation": [1.0, float("nan")]}, "observation contains NaN"),
        ({"reward": None}, "reward has 1 values that are null"),
    ]
    for changed, message in rows:
        with (
            subtests.test(message),
            pytest.raises(ConfigError, match=rf"^training\.data: .*shared\.parquet: .*{message}"),
        ):
            RecordedGames.read(written(tmp_path, [*ROWS[:-1], ROWS[-1] | changed]), "shared", SPACES)
    texts = [decision | {"action": str(decision["action"])} for decision in ROWS]
    with pytest.raises(ConfigError, match=r"^training\.data: .*shared\.parquet: .*action"):
        RecordedGames.read(written(tmp_path, texts), "shared", SPACES)


def test_a_file_without_decisions_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no decisions to learn from"):
        RecordedGames.read(written(tmp_path, ROWS[-1:]), "shared", SPACES)
