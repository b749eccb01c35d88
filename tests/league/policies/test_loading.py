"""Loading a verified policy from a reference, of a version that was trained in the environment of its league."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import league.policies
from evaluation.gating.nightly import nightly
from evaluation.matches.tournament import evaluate
from evaluation.matches.worker import MatchWorker
from evaluation.schedules.builders import round_robin
from league.errors import (
    ArtifactCorrupt,
    EnvironmentMismatch,
    InvalidInput,
    InvalidReference,
    UnknownAlias,
    UnknownLeague,
    UnknownPolicy,
)
from league.policies.loading import check_eligible, contestant, eligible, pinned
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.leagues import tictactoe
from tests.support.leagues.registries import LEAGUE, builder, interface, registered
from tests.support.policies.graphs import masked_mlp

GRAPHS = [masked_mlp(shape=(3, 3, 2), actions=9, seed=seed) for seed in (1, 2)]


BATCH = {"observation": np.eye(18, dtype=np.int8).reshape(18, 3, 3, 2), "action_mask": np.ones((18, 9), np.int8)}


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


LARGER = {"entry_point": "pettingzoo.classic.tictactoe_v3", "kwargs": {"screen_height": 500}}


MISMATCH = (
    r"tictactoe@1 was trained in another environment \(\w{12}\) than tictactoe has now \(\w{12}\), with kwargs \{\} "
)


@pytest.fixture
def moved(tmp_path: Path) -> Registry:
    """Version 1 was trained in an earlier environment of the league, versions 2 and 3 in its current one."""
    opened = tictactoe.registry(tmp_path, play={"opening_plies": 2, "num_envs": 4})
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    row = opened.leagues.get(tictactoe.LEAGUE)
    changed = tictactoe.config(environment=LARGER, play={"opening_plies": 2, "num_envs": 4}, gate={"max_blocks": 4})
    opened.leagues.register(changed, row.interface)
    for _ in range(2):
        tictactoe.publish(opened, tictactoe.graph(wins=True, blocks=True))
    return opened


def test_versions_of_another_environment_are_not_selected(moved: Registry) -> None:
    assert [version.ref for version in eligible(moved, tictactoe.LEAGUE)] == ["tictactoe@2", "tictactoe@3"]
    with pytest.raises(UnknownLeague):
        eligible(moved, "chess")


def test_a_champion_of_another_environment_is_reported_as_a_fault(moved: Registry) -> None:
    """It remains champion, no candidate is compared with it, and all other versions are rated."""
    moved.aliases.set(tictactoe.LEAGUE, "champion", 1, expected=None, actor="me", reason="test")
    report = nightly(moved.leagues.get(tictactoe.LEAGUE).config, registry=moved)
    assert (report.champion, report.verdicts) == ("tictactoe@1", ())
    assert {fault.partition(":")[0] for fault in report.faults} >= {
        "tictactoe@2 against tictactoe@1",
        "tictactoe@3 against tictactoe@1",
    }
    assert all("tictactoe@1 was trained in another environment" in fault for fault in report.faults)
    rated = {standing.ref for standing in report.leaderboard if standing.rating is not None}
    assert rated == {"tictactoe@2", "tictactoe@3", "script:random", "script:one_ply"}


def test_a_version_of_another_league_is_rejected(moved: Registry) -> None:
    row = moved.leagues.get(tictactoe.LEAGUE)
    other = tictactoe.config(league="elsewhere", environment=LARGER)
    moved.leagues.register(other, row.interface)
    tictactoe.publish(moved, tictactoe.graph(), "elsewhere")
    with pytest.raises(EnvironmentMismatch, match="elsewhere@1 is not a version of league tictactoe"):
        pinned("elsewhere@1", tictactoe.LEAGUE, moved)
    schedule = round_robin(row.config, row.interface, ["elsewhere@1", "tictactoe@2"], 2)
    with pytest.raises(EnvironmentMismatch, match="elsewhere@1 is not a version of league tictactoe"):
        MatchWorker(row.config, moved).play(schedule, [0])


def test_a_requested_version_of_another_environment_is_rejected(moved: Registry) -> None:
    with pytest.raises(EnvironmentMismatch, match=MISMATCH + r"instead of \{'screen_height': 500\}"):
        evaluate(tictactoe.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=moved)
    assert Ledger(moved).schedules(tictactoe.LEAGUE) == []
    row = moved.leagues.get(tictactoe.LEAGUE)
    for ref in ("tictactoe@2", "script:random"):
        check_eligible(ref, moved, row.config)
    schedule = round_robin(row.config, row.interface, ["tictactoe@1", "tictactoe@2"], 2)
    with pytest.raises(EnvironmentMismatch, match=MISMATCH):
        MatchWorker(row.config, moved).play(schedule, [0])
