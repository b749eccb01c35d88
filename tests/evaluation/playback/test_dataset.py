"""Recorded games as Parquet: what was observed, decided and earned."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from pettingzoo.classic import tictactoe_v3

from evaluation.matches.tournament import evaluate
from evaluation.playback import dataset
from evaluation.playback.dataset import write_games
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch, NotFound
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home")
    for graph in (tictactoe.graph(), tictactoe.graph(wins=True)):
        tictactoe.publish(opened, graph)
    yield opened
    opened.close()


def rows_of(path: Path) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    return sorted(rows, key=lambda row: (row["match"], row["game"], row["step"], row["agent"]))


def test_the_rows_are_the_recorded_games(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dataset, "ROWS_OF_GROUP", 7)
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2", "script:random"), registry=registry, blocks=2)
    counts = write_games(registry, LEAGUE, tmp_path / "games")
    rows = rows_of(tmp_path / "games" / "shared.parquet")
    assert counts == {"shared": len(rows)}
    matches = {match.id: match for match in Ledger(registry).matches(league=LEAGUE)}
    assert {row["match"] for row in rows} == set(matches)
    for match in matches.values():
        for number, game in enumerate(match.games):
            decisions = [row for row in rows if (row["match"], row["game"]) == (match.id, number)]
            assert [row["action"] for row in decisions] == [*game.opening, *game.actions]
            assert [row["is_opening"] for row in decisions] == [True] * len(game.opening) + [False] * len(game.actions)
            assert all(row["action_mask"][row["action"]] for row in decisions)
            for side, agent in enumerate(("player_1", "player_2")):
                of_agent = [row for row in decisions if row["agent"] == agent]
                assert {row["player"] for row in of_agent} == {match.contestants[game.sides[side]]}
                assert sum(row["reward"] for row in of_agent) == game.returns[game.sides[side]]
                assert [row["terminated"] for row in of_agent] == [False] * (len(of_agent) - 1) + [True]


def test_observations_are_those_of_the_environment(registry: Registry, tmp_path: Path) -> None:
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2"), registry=registry, blocks=1)
    write_games(registry, LEAGUE, tmp_path / "games", limit=1)
    path = tmp_path / "games" / "shared.parquet"
    shapes = json.loads(pq.read_schema(path).metadata[b"policy_league"])["shapes"]
    environment = tictactoe_v3.env()
    environment.reset()
    for row in rows_of(path):
        assert row["agent"] == environment.agent_selection
        for name, array in environment.observe(row["agent"]).items():
            np.testing.assert_array_equal(np.reshape(row[name], shapes[name]), array)
        environment.step(row["action"])
    assert all(environment.terminations.values())


def always_one(_: NDArray) -> int:
    return 1


def test_agents_that_act_together_and_leave_at_different_times(registry: Registry, tmp_path: Path) -> None:
    """Agent i observes (i, step, seed modulo 97), and earns 10^i in each step."""
    meeting = {
        "entry_point": "tests.support.environments.simultaneous:meeting",
        "kwargs": {"leaves": [2, 4], "truncated": [1]},
    }
    config = LeagueConfig.from_mapping(
        {"league": "meeting", "environment": meeting, "policies": {"a": ["agent_0"], "b": ["*"]}}
    )
    registry.leagues.register(config, interface(config))
    evaluate("meeting", ("script:random", f"script:{__name__}:always_one"), registry=registry, blocks=1)
    assert write_games(registry, "meeting", tmp_path / "games", limit=1) == {"a": 2, "b": 4}
    for agent, (name, length) in enumerate((("a", 2), ("b", 4))):
        rows = rows_of(tmp_path / "games" / f"{name}.parquet")
        assert [row["step"] for row in rows] == list(range(length))
        assert [row["observation"][:2] for row in rows] == [[agent, time] for time in range(length)]
        assert [row["reward"] for row in rows] == [10**agent] * length
        assert (rows[-1]["terminated"], rows[-1]["truncated"]) == (agent == 0, agent == 1)
        assert not any(row["terminated"] or row["truncated"] for row in rows[:-1])


def test_decisions_of_one_player(registry: Registry, tmp_path: Path) -> None:
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2"), registry=registry, blocks=2)
    write_games(registry, LEAGUE, tmp_path / "games", ["tictactoe@2"], limit=3)
    rows = rows_of(tmp_path / "games" / "shared.parquet")
    assert {row["player"] for row in rows} == {"tictactoe@2"}
    assert len({(row["match"], row["game"]) for row in rows}) == 3


def test_nothing_is_written_after_a_fault(registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = tmp_path / "games"
    with pytest.raises(NotFound, match="tictactoe has no games under its current rules"):
        write_games(registry, LEAGUE, directory)
    evaluate(LEAGUE, ("tictactoe@1", "tictactoe@2"), registry=registry, blocks=1)
    tictactoe.publish(registry, tictactoe.graph(blocks=True))
    with pytest.raises(NotFound, match="tictactoe has no games of tictactoe@3 under its current rules"):
        write_games(registry, LEAGUE, directory, ["tictactoe@3"])

    def deviate(*_: Any) -> Any:
        raise EnvironmentMismatch("the game deviates")

    monkeypatch.setattr(dataset, "_rewarded", deviate)
    with pytest.raises(EnvironmentMismatch):
        write_games(registry, LEAGUE, directory)
    assert [path.name for path in tmp_path.iterdir()] == ["home"]
    directory.mkdir()
    (directory / "mine").touch()
    with pytest.raises(ConfigError, match="expected a new or empty folder"):
        write_games(registry, LEAGUE, directory)
