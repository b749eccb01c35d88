"""Importing models into a league."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from rich.console import Console
from scipy.special import softmax

from evaluation.matches.tournament import evaluate
from league.errors import ConfigError, EnvironmentMismatch, InvalidInput, ParityError
from league.policies import load
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from league.search.policies import publish_search
from tests.support.leagues import tictactoe
from tests.support.policies.foreign_graphs import foreign, influenced, recurrent
from training.importing import checks
from training.importing.open_source import open_sources
from training.importing.publish import publish
from training.runs.parent import check_network
from training.runs.train import train


@pytest.fixture(autouse=True)
def few_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "IMPORTED", replace(checks.IMPORTED, observations=400))


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = tictactoe.registry(tmp_path / "home")
    yield opened
    opened.close()


@pytest.fixture
def mapping(tmp_path: Path) -> Path:
    return tmp_path / "names.yaml"


def write_mapping(path: Path, kind: str) -> None:
    path.write_text(f"inputs: {{planes: observation}}\noutput: policy_head\nkind: {kind}\n")


def graph(directory: Path, shape: tuple[int, ...] | None = (3, 3, 2), **options: Any) -> Path:
    path = directory / "foreign.onnx"
    path.write_bytes(foreign(18, 9, shape=shape, **options))
    return path


def imported(registry: Registry, path: Path, mapping: Path | None = None) -> VersionRow:
    interface = registry.leagues.get(tictactoe.LEAGUE).interface
    sources, digest = open_sources(path, interface, mapping=mapping)
    return publish(tictactoe.LEAGUE, sources, digest=digest, registry=registry)


def test_an_imported_graph_is_a_version_like_others(registry: Registry, tmp_path: Path) -> None:
    path = graph(tmp_path)
    version = imported(registry, path)
    policy = version.manifest.policies["shared"]
    assert (policy.parity.mismatches, policy.parity.observations >= 400) == (0, True)
    assert [tensor.name for tensor in policy.inputs] == ["observation", "action_mask"]
    assert version.manifest.settings["origin"]["shared"]["file"] == "foreign.onnx"
    load(version.ref, registry=registry)
    report = evaluate(tictactoe.LEAGUE, [version.ref, "script:random"], registry=registry, blocks=4, workers=0)
    assert {standing.ref for standing in report.leaderboard} >= {version.ref, "script:random"}
    assert imported(registry, path).number == version.number


def test_training_cannot_start_from_an_imported_version(registry: Registry, tmp_path: Path) -> None:
    version, league = imported(registry, graph(tmp_path)), registry.leagues.get(tictactoe.LEAGUE)
    with pytest.raises(ConfigError, match=r"tictactoe@1 was imported: it has no training state"):
        check_network(version, tictactoe.config())
    with pytest.raises(InvalidInput, match=r"tictactoe@1 has no value graph, which a search needs\."):
        publish_search(registry, version, league.config.environment, league.interface, "puct", 4)


EXTENDING = "policy_league.examples.extending"
SHORT = {"runners": 1, "num_envs": 4, "steps": 128, "strength": None}
PPO = {"train_batch_size": 64, "minibatch_size": 64}
SAC = {"learning_starts": 64, "batch_size": 32}


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    "training",
    [
        PPO | {"network": {"entry_point": f"{EXTENDING}.residual:Residual", "kwargs": {"blocks": 1, "channels": 2}}},
        PPO | {"algorithm": f"{EXTENDING}.separate_critic:SeparatePPO"},
        SAC | {"algorithm": f"{EXTENDING}.sac:SAC"},
        PPO | {"critic": "central"},
    ],
    ids=["network", "PPO of one's own", "off-policy of one's own", "MAPPO"],
)
def test_what_extends_training_plays_against_an_imported_version(
    training: dict[str, Any], registry: Registry, tmp_path: Path
) -> None:
    imported(registry, graph(tmp_path))
    (version,) = train(
        tictactoe.config(training=SHORT | training | {"opponents": [{"ref": "@1", "share": 1.0}]}),
        registry=registry,
        console=Console(quiet=True),
    )
    (run,) = registry.runs.newest(tictactoe.LEAGUE)
    assert "opponents/tictactoe@1/score" in registry.runs.get(tictactoe.LEAGUE, run.id).curves
    assert version.number == 2


def test_weights_in_another_file_are_included(registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "foreign.onnx"
    onnx.save(
        onnx.load_from_string(foreign(18, 9, shape=(3, 3, 2))), str(path), save_as_external_data=True,
        location="weights.bin", size_threshold=0,
    )  # fmt: skip
    assert (tmp_path / "weights.bin").exists()
    version = imported(registry, path)
    (tmp_path / "weights.bin").unlink()
    load(version.ref, registry=registry)


def test_a_mapping_file_names_the_tensors(registry: Registry, tmp_path: Path, mapping: Path) -> None:
    path = graph(tmp_path, shape=None)
    with pytest.raises(EnvironmentMismatch, match="mapping file"):
        imported(registry, path)
    write_mapping(mapping, "values")
    assert imported(registry, path, mapping).number == 1


def test_probabilities_are_not_taken_for_logits(registry: Registry, tmp_path: Path, mapping: Path) -> None:
    path = graph(tmp_path, kind="probabilities")
    with pytest.raises(ParityError, match=r"policy_head are from 0 to 1 with the sum 1.* `kind: probabilities`"):
        imported(registry, path)
    write_mapping(mapping, "probabilities")
    policy = load(imported(registry, path, mapping).ref, registry=registry)
    legal = np.ones((1, 9), np.int8)
    legal[0, 0] = 0
    observation = {"observation": np.ones((1, 3, 3, 2), np.int8), "action_mask": legal}
    dist_inputs = policy.act(observation, explore=True, rng=[np.random.default_rng(0)]).dist_inputs
    assert dist_inputs is not None
    weights = onnx.numpy_helper.to_array(onnx.load_from_string(foreign(18, 9)).graph.initializer[0])
    expected = np.where(legal[0] != 0, np.exp(weights.sum(axis=0)), 0)
    np.testing.assert_allclose(softmax(dist_inputs[0]), expected / expected.sum(), rtol=1e-4)


def test_logits_are_not_taken_for_probabilities(registry: Registry, tmp_path: Path, mapping: Path) -> None:
    write_mapping(mapping, "probabilities")
    with pytest.raises(ParityError, match=r"for \d+ of \d+ observations, policy_head is not probabilities: expected"):
        imported(registry, graph(tmp_path), mapping)


def test_illegal_actions_are_refused(registry: Registry, tmp_path: Path) -> None:
    with pytest.raises(ParityError, match=r"policy shared: action [0-9] is illegal, where action_mask"):
        imported(registry, graph(tmp_path, kind="action"))
    assert registry.versions.all(tictactoe.LEAGUE) == []


OTHER_ROWS = "computes other .* 256 observations alone than in a batch: its rows influence each other"
SECOND_RUN = "computes other outputs for 256 of 256 observations in a second run: as with Dropout or BatchNorm"


def test_a_graph_acts_on_each_observation_by_itself(
    registry: Registry, tmp_path: Path, subtests: pytest.Subtests
) -> None:
    path = tmp_path / "foreign.onnx"
    for kind, problem in (
        ("softmax", OTHER_ROWS),
        ("running_sum", OTHER_ROWS),
        ("normalized", SECOND_RUN),
        ("ranked", OTHER_ROWS),
        ("dropout", "greedy actions of the source differ from run to run, as with Dropout"),
    ):
        path.write_bytes(influenced(kind))
        with subtests.test(kind), pytest.raises(ParityError, match=f"policy shared:? {problem}"):
            imported(registry, path)
    assert registry.versions.all(tictactoe.LEAGUE) == []


def test_a_graph_with_the_layers_of_its_state_first_acts_on_each_observation_by_itself(
    registry: Registry, tmp_path: Path, mapping: Path
) -> None:
    path = tmp_path / "foreign.onnx"
    mapping.write_text(
        "{inputs: {planes: observation}, output: policy_head, kind: logits, state: {h_in: h_out, c_in: c_out}}"
    )
    path.write_bytes(recurrent(18, 9, operator="LSTM", layers=2))
    policy = load(imported(registry, path, mapping).ref, registry=registry)
    observation = {"observation": np.ones((3, 3, 3, 2), np.int8), "action_mask": np.ones((3, 9), np.int8)}
    state = policy.act(observation).state
    assert state is not None
    assert {name: array.shape for name, array in state.items()} == {"state_in_0": (3, 2, 4), "state_in_1": (3, 2, 4)}
    mixing = onnx.load_from_string(path.read_bytes())
    (after,) = [node for node in mixing.graph.node if "c_out" in node.output]
    after.output[:] = ["apart"]
    mixing.graph.initializer.append(onnx.numpy_helper.from_array(np.int64(1), "batch_axis"))
    mixing.graph.node.append(onnx.helper.make_node("CumSum", ["apart", "batch_axis"], ["c_out"]))
    path.write_bytes(mixing.SerializeToString())
    with pytest.raises(ParityError, match=OTHER_ROWS):
        imported(registry, path, mapping)


def test_files_that_cannot_be_read_are_named(
    registry: Registry, tmp_path: Path, mapping: Path, subtests: pytest.Subtests
) -> None:
    for name, content in (("graph.onnx", b"text"), ("graph.h5", b"text"), ("a.onnx", b"")):
        (tmp_path / name).write_bytes(content)
        with subtests.test(name), pytest.raises(ConfigError, match=name):
            imported(registry, tmp_path / name)
    path = graph(tmp_path, shape=None)
    for text in ("[" * 1000, "kind: " + "1" * 5000, "2024-13-45: 1", "a: &a [*a]", "\x00", "{inputs: {planes: [1]}}"):
        mapping.write_text(text)
        with subtests.test(text[:20]), pytest.raises(ConfigError, match=r"names\.yaml: [^\n]+$"):
            imported(registry, path, mapping)
