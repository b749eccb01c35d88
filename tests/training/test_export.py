from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ParityError
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from tests.training.leagues import counting, tictactoe
from training import parity
from training.algorithms.ppo import module_spec
from training.export import export_policy, graph_tensors
from training.modules.actor_critic import MASKED, ActorCritic

CONVOLVED = {"convolutions": [{"filters": 4, "kernel": 2}], "hidden": [8]}


def modules_of(league: LeagueConfig) -> tuple[Interface, dict[str, ActorCritic]]:
    torch.manual_seed(3)
    described = interface(league)
    modules = module_spec(league.training, described).build()
    return described, {policy: modules[policy] for policy in described.policy_ids}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Interface, ActorCritic, Path, parity.Batches]:
    """A masked, convolutional policy, its graph, and observations from its environment."""
    league = tictactoe(**CONVOLVED)
    described, modules = modules_of(league)
    path = tmp_path_factory.mktemp("export") / "shared.onnx"
    export_policy(modules["shared"], described.of_policy("shared"), path)
    batches = parity.gather(league.environment, described, modules, seed=1)["shared"]
    return described, modules["shared"], path, batches


def test_the_graph_is_one_file_with_the_environments_names_and_dtypes(exported: tuple) -> None:
    described, _, path, _ = exported
    model = onnx.load(path, load_external_data=False)
    onnx.checker.check_model(model)
    assert not any(tensor.external_data for tensor in model.graph.initializer)
    assert list(path.parent.iterdir()) == [path]
    session = onnxruntime.InferenceSession(path)
    inputs, outputs = graph_tensors(described.of_policy("shared"))
    for tensors, nodes in ((inputs, session.get_inputs()), (outputs, session.get_outputs())):
        assert [node.name for node in nodes] == [tensor.name for tensor in tensors]
        assert [tuple(node.shape[1:]) for node in nodes] == [tensor.shape[1:] for tensor in tensors]
        assert all(isinstance(node.shape[0], str) for node in nodes)
    assert [node.type for node in session.get_inputs()] == ["tensor(int8)", "tensor(int8)"]
    assert [node.type for node in session.get_outputs()] == ["tensor(int64)", "tensor(float)"]


def test_observations_come_from_play_and_are_enough(exported: tuple) -> None:
    *_, batches = exported
    planes = np.concatenate([batch["observation"] for batch in batches])
    masks = np.concatenate([batch["action_mask"] for batch in batches])
    assert len(planes) >= 2000
    assert planes.dtype == masks.dtype == np.int8
    assert (planes.reshape(len(planes), -1).sum(-1) + masks.sum(-1) == 9).all(), "stones and free cells"
    assert len(np.unique(planes.reshape(len(planes), -1), axis=0)) > 500


def test_the_proof_holds_and_actions_are_legal_in_any_batch(exported: tuple) -> None:
    _, module, path, batches = exported
    proof = parity.prove(path, "shared", module, batches)
    assert proof.observations >= 2000
    assert proof.mismatches == 0
    assert proof.max_difference < 1e-4
    policy = OnnxPolicy(path)
    rows = {name: np.concatenate([batch[name] for batch in batches[:20]]) for name in batches[0]}
    together = policy.act(rows).actions
    singly = [policy.act({name: array[i : i + 1] for name, array in rows.items()}).actions[0] for i in range(50)]
    assert together[:50].tolist() == singly
    assert (rows["action_mask"][np.arange(len(together)), together] == 1).all()


def test_a_graph_of_other_weights_is_refused(exported: tuple, tmp_path: Path) -> None:
    described, module, _, batches = exported
    other = module_spec(tictactoe(**CONVOLVED).training, described).build()["shared"]
    other.set_state(module.get_state())
    with torch.no_grad():
        other.policy_head.weight[4] += 0.05
    export_policy(other, described.of_policy("shared"), tmp_path / "other.onnx")
    with pytest.raises(ParityError, match=r"differs from its module on [1-9]\d* of 2\d\d\d greedy actions"):
        parity.prove(tmp_path / "other.onnx", "shared", module, batches)


def test_a_graph_that_would_explore_otherwise_is_refused(exported: tuple, tmp_path: Path) -> None:
    """The same greedy actions, at another temperature."""
    described, module, _, batches = exported
    other = module_spec(tictactoe(**CONVOLVED).training, described).build()["shared"]
    other.set_state(module.get_state())
    with torch.no_grad():
        other.policy_head.weight *= 2
        other.policy_head.bias *= 2
    export_policy(other, described.of_policy("shared"), tmp_path / "other.onnx")
    with pytest.raises(ParityError, match="on 0 of"):
        parity.prove(tmp_path / "other.onnx", "shared", module, batches)


def test_near_ties_are_counted_not_refused(exported: tuple, tmp_path: Path) -> None:
    """Two modules whose best two actions swap by less than 1e-5."""
    described, module, _, batches = exported
    first, second = (module_spec(tictactoe(**CONVOLVED).training, described).build()["shared"] for _ in range(2))
    for net, bias in ((first, [4e-6, 0.0]), (second, [0.0, 4e-6])):
        with torch.no_grad():
            net.policy_head.weight.zero_()
            net.policy_head.bias.copy_(torch.tensor([*bias, *[-1.0] * 7]))
    export_policy(second, described.of_policy("shared"), tmp_path / "second.onnx")
    proof = parity.prove(tmp_path / "second.onnx", "shared", first, batches)
    both_legal = sum(int((batch["action_mask"][:, :2] == 1).all(-1).sum()) for batch in batches)
    assert proof.mismatches == 0
    assert proof.near_ties == both_legal > 0
    del module


def test_a_network_that_has_diverged_is_refused(exported: tuple) -> None:
    described, _, path, batches = exported
    diverged = module_spec(tictactoe(**CONVOLVED).training, described).build()["shared"]
    with torch.no_grad():
        diverged.policy_head.bias.fill_(float("nan"))
    with pytest.raises(ParityError, match="diverged"):
        parity.prove(path, "shared", diverged, batches)


def test_each_policy_without_a_mask(tmp_path: Path) -> None:
    league = counting([3, 5], [])
    described, modules = modules_of(league)
    batches = parity.gather(league.environment, described, modules, seed=1)
    for policy, module in modules.items():
        path = tmp_path / f"{policy}.onnx"
        export_policy(module, described.of_policy(policy), path)
        assert [node.name for node in onnxruntime.InferenceSession(path).get_inputs()] == ["observation"]
        assert parity.prove(path, policy, module, batches[policy]).observations >= 2000


def test_a_policy_that_hardly_acts_cannot_be_proven(monkeypatch: pytest.MonkeyPatch) -> None:
    league = counting([3, 5], [])
    described, modules = modules_of(league)
    monkeypatch.setattr(parity, "MOVES_PER_OBSERVATION", 1)
    with pytest.raises(ParityError, match=r"policy policy_0 met \d+ observations"):
        parity.gather(league.environment, described, modules, seed=1)


def test_masked_logits_are_exported_as_they_are(exported: tuple) -> None:
    _, _, path, batches = exported
    rng = [np.random.default_rng(0)] * len(batches[-1]["action_mask"])
    logits = OnnxPolicy(path).act(batches[-1], explore=True, rng=rng).dist_inputs
    assert ((logits == np.float32(MASKED)) == (batches[-1]["action_mask"] == 0)).all()
