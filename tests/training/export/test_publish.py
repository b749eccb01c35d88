import json
import subprocess
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from league.environments.building import interface
from league.errors import ParityError
from league.policies import load
from league.policies.graph_runs import open_session
from league.policies.onnx import OnnxPolicy
from league.policies.probes import Probes
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from league.settings import Storage
from league.spaces import Discrete
from league.stack import installed
from tests.support.algorithms import running
from tests.support.leagues.training_leagues import solvable, tictactoe
from training.export import parity
from training.export import publish as publishing
from training.export.publish import Checkpoint, git_commit, load_modules, load_scales, publish

LEAGUE = tictactoe(train_batch_size=64, minibatch_size=32, epochs=1, normalize_values=True)


@pytest.fixture(scope="module")
def trained(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """RLlib's state after one update, in this process and without Tune."""
    path = tmp_path_factory.mktemp("trained") / "64"
    with running(LEAGUE) as algorithm:
        algorithm.train()
        algorithm.save_to_path(str(path))
    return path


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    registry = Registry.open(Storage.at(tmp_path / "home"))
    registry.leagues.register(LEAGUE, interface(LEAGUE))
    yield registry
    registry.close()


def publish_checkpoint(registry: Registry, trained: Path, source: str = "run/64", parent: int | None = None) -> int:
    row = publish(
        Checkpoint(trained, source=source, steps=64),
        registry=registry,
        config=LEAGUE,
        interface=interface(LEAGUE),
        parent=parent,
        git_commit="abc",
    )
    return row.number


def test_a_version_has_a_complete_manifest_and_acts_like_its_checkpoint(registry: Registry, trained: Path) -> None:
    first = publish_checkpoint(registry, trained)
    assert publish_checkpoint(registry, trained) == first, "a checkpoint is published once"
    number = publish_checkpoint(registry, trained, source="run/65", parent=first)
    assert len(registry.versions.all("tictactoe")) == 2
    manifest = registry.versions.get("tictactoe", number).manifest
    assert manifest.interface == interface(LEAGUE)
    assert manifest.environment == LEAGUE.environment
    assert (manifest.algorithm, manifest.seed, manifest.steps) == ("ppo", 5, 64)
    assert (manifest.parent, manifest.git_commit) == (first, "abc")
    assert manifest.settings["lambda"] == LEAGUE.training.lambda_
    assert manifest.stack == installed()
    assert manifest.policies["shared"].parity.observations >= 2000
    artefact = registry.artifacts.path("tictactoe", number)
    probes = Probes.from_bytes((artefact / "shared.probes.npz").read_bytes(), "probes")
    assert len(probes) == 32
    assert len({board.tobytes() for board in probes.observations["observation"]}) > 16
    probes.check(OnnxPolicy(artefact / "shared.onnx"), Discrete(n=9), "probes")
    assert (artefact / TRAINING / "algorithm_state.pkl").is_file()
    module = load_modules(artefact / TRAINING, LEAGUE, interface(LEAGUE))["shared"]
    policy = OnnxPolicy(artefact / "shared.onnx", manifest.policies["shared"])
    rows = {"observation": np.zeros((1, 3, 3, 2), np.int8), "action_mask": np.ones((1, 9), np.int8)}
    tensors = {name: torch.from_numpy(array) for name, array in rows.items()}
    expected = module.forward_inference({"obs": tensors})["action_dist_inputs"].argmax(-1)
    assert policy.act(rows).actions.tolist() == expected.tolist()
    assert {"shared.onnx", "shared.value.onnx"} < manifest.files.keys()
    logits, values = open_session((artefact / "shared.value.onnx").read_bytes()).run(None, rows)
    scale = load_scales(artefact / TRAINING, LEAGUE)["shared"]
    assert scale.deviation != 1
    module_values = module.compute_values({"obs": tensors}).detach().numpy()
    np.testing.assert_allclose(values, scale.denormalized(module_values), atol=1e-5)
    np.testing.assert_allclose(logits, policy.distribution(rows).dist_inputs, atol=1e-5)


@pytest.mark.usefixtures("ray_session")
def test_a_recurrent_policy_is_exported_with_its_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, observations=256))
    league = solvable("remembering", recurrence={"width": 4}, train_batch_size=128)
    interface_of_league = interface(league)
    with running(league) as algorithm:
        algorithm.save_to_path(str(tmp_path / "0"))
    with closing(Registry.open(Storage.at(tmp_path / "home"))) as registry:
        registry.leagues.register(league, interface_of_league)
        source = Checkpoint(tmp_path / "0", source="run/0", steps=0)
        row = publish(
            source, registry=registry, config=league, interface=interface_of_league, parent=None, git_commit=None
        )
        assert [tensor.name for tensor in row.manifest.policies["shared"].state] == ["state_in_0", "state_in_1"]
        assert row.manifest.policies["shared"].value is None
        probes = Probes.from_bytes(registry.artifacts.read(row.manifest, "shared.probes.npz"), "probes")
        assert probes.state["state_in_1"].any(), "no probe is from within an episode"
        policy = load(row.ref, registry=registry)
        batch, state = {"observation": np.array([1, 0])}, None
        outputs = []
        for _ in range(3):
            answer = policy.act(batch, state=state, explore=True, rng=[np.random.default_rng(0)] * 2)
            state = answer.state
            assert answer.dist_inputs is not None
            outputs.append(answer.dist_inputs)
        assert not np.array_equal(outputs[0], outputs[1])
        module = load_modules(tmp_path / "0", league, interface_of_league)["shared"]
        again = {"obs": {"observation": torch.tensor([1, 0])}}
        before = {key: torch.zeros(2, 4) for key in module.get_initial_state()}
        for expected in outputs:
            answer_of_module = module.forward_inference(again | {"state_in": before})
            np.testing.assert_allclose(answer_of_module["action_dist_inputs"], expected, atol=1e-6)
            before = answer_of_module["state_out"]


def test_a_failed_parity_check_leaves_no_version(
    registry: Registry, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The graph is exported from a module with modified weights."""
    export = publishing.export_policy

    def tampered(module: torch.nn.Module, *rest: object) -> None:
        before = module.policy_head.weight.detach().clone()
        with torch.no_grad():
            module.policy_head.weight[4] += 0.05
        export(module, *rest)
        with torch.no_grad():
            module.policy_head.weight.copy_(before)

    monkeypatch.setattr(publishing, "export_policy", tampered)
    with pytest.raises(ParityError):
        publish_checkpoint(registry, trained)
    assert registry.versions.all("tictactoe") == []
    artifacts = registry.storage.artifacts
    assert not [path for path in artifacts.rglob("*") if path.is_file()]


def test_the_git_commit_requires_a_tracked_file(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    config = tmp_path / "league.yaml"
    config.write_text(json.dumps({}))
    assert git_commit(config) is None
    git("init", "-q")
    assert git_commit(config) is None
    git("add", "league.yaml")
    git("commit", "-qm", "first")
    assert git_commit(config) == git("rev-parse", "HEAD")
    assert git_commit(tmp_path / "other.yaml") is None
    assert git_commit(None) is None
