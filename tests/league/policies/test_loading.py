"""Loading a verified policy from a reference."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import league.policies
from league.errors import (
    ArtifactCorrupt,
    EnvironmentMismatch,
    InvalidInput,
    InvalidReference,
    UnknownAlias,
    UnknownPolicy,
)
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import LEAGUE, builder, interface, registered
from tests.support.policies.graphs import masked_mlp

GRAPHS = [masked_mlp(shape=(3, 3, 2), actions=9, seed=seed) for seed in (1, 2)]
BATCH = {
    "observation": np.eye(18, dtype=np.int8).reshape(18, 3, 3, 2),
    "action_mask": np.ones((18, 9), np.int8),
}


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """A league with two versions that act differently; the second is the champion."""
    registry = registered(Registry.open(Storage.at(tmp_path)))
    for i, graph in enumerate(GRAPHS):
        registry.publisher.publish(LEAGUE, builder(graph=graph), source=f"run/{i}")
    registry.aliases.set(LEAGUE, "champion", 2, expected=None, actor="ann", reason="better")
    yield registry
    registry.close()


def test_references_load_the_policies_they_name(registry: Registry) -> None:
    expected = [OnnxPolicy(graph).act(BATCH).actions.tolist() for graph in GRAPHS]
    assert expected[0] != expected[1]
    for ref, actions in {"1": expected[0], "2": expected[1], "champion": expected[1]}.items():
        policy = league.policies.load(f"tictactoe@{ref}", registry=registry)
        assert policy.act(BATCH).actions.tolist() == actions
    named = league.policies.load("tictactoe@1", "shared", registry)
    assert named.act(BATCH).actions.tolist() == expected[0]


def test_the_default_registry_is_that_of_the_environment_variables(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LEAGUE_HOME", str(registry.storage.home))
    monkeypatch.delenv("LEAGUE_DATABASE_URL", raising=False)
    monkeypatch.delenv("LEAGUE_ARTIFACTS", raising=False)
    expected = OnnxPolicy(GRAPHS[1]).act(BATCH).actions.tolist()
    assert league.policies.load("tictactoe@champion").act(BATCH).actions.tolist() == expected


def test_unknown_policies_aliases_and_references_are_reported(registry: Registry) -> None:
    with pytest.raises(UnknownPolicy, match="tictactoe@1 has no policy 'white'; known: shared"):
        league.policies.load("tictactoe@1", "white", registry)
    with pytest.raises(UnknownAlias):
        league.policies.load("tictactoe@best", registry=registry)
    with pytest.raises(InvalidReference, match="expected LEAGUE@NUMBER or LEAGUE@ALIAS"):
        league.policies.load("tictactoe", registry=registry)


def test_a_tampered_graph_is_not_loaded(registry: Registry) -> None:
    (registry.artifacts.path(LEAGUE, 2) / "shared.onnx").write_bytes(GRAPHS[0])
    with pytest.raises(ArtifactCorrupt, match=r"2/shared\.onnx was changed"):
        league.policies.load("tictactoe@champion", registry=registry)


def test_a_contestant_acts_for_every_agent(registry: Registry) -> None:
    players = contestant("tictactoe@champion", registry, interface())
    assert list(players) == ["player_1", "player_2"]
    assert {policy_id for policy_id, _ in players.values()} == {"shared"}
    assert players["player_1"][1] is players["player_2"][1]
    expected = OnnxPolicy(GRAPHS[1]).act(BATCH).actions.tolist()
    assert players["player_1"][1].act(BATCH).actions.tolist() == expected


def test_a_script_can_be_a_contestant(registry: Registry) -> None:
    players = contestant("script:one_ply", registry, interface())
    rng = [np.random.default_rng(row) for row in range(18)]
    assert players["player_1"] == players["player_2"]
    assert set(players["player_1"][1].act(BATCH, rng=rng).actions.tolist()) <= set(range(9))
    assert list(contestant("script:first", None, interface())) == ["player_1", "player_2"]
    with pytest.raises(InvalidInput, match="tictactoe@1 is a version: without a registry"):
        contestant("tictactoe@1", None, interface())
    with pytest.raises(UnknownPolicy, match="unknown script 'minimax'"):
        contestant("script:minimax", registry, interface())


def test_a_version_with_another_interface_is_rejected(registry: Registry) -> None:
    with pytest.raises(EnvironmentMismatch, match="spaces or policies of tictactoe@2 differ"):
        contestant("tictactoe@champion", registry, interface(squares=4))


def test_loading_imports_neither_environments_nor_training() -> None:
    packages = ("torch", "ray", "pettingzoo", "gymnasium", "supersuit", "alembic", "scipy", "onnx")
    program = (
        "import sys; import league.policies.loading, league.results.ledger; "
        f"print(sorted(set({packages}) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
