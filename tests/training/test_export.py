from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ParityError
from league.interface import Interface
from league.policies.actions import dist_inputs_size
from league.policies.onnx import OnnxPolicy
from league.spaces import MultiDiscrete, to_gymnasium
from tests.training.leagues import counting, solvable, tictactoe
from training import parity
from training.algorithms.ppo import module_spec
from training.export import export_policy, graph_tensors
from training.modules.actor_critic import MASKED, ActorCritic
from training.parity import Met

CONVOLVED = {"convolutions": [{"filters": 4, "kernel": 2}], "hidden": [8]}
MEMORY = {"recurrence": {"width": 6}}


def modules_of(league: LeagueConfig) -> tuple[Interface, dict[str, ActorCritic]]:
    """With preferences: a new policy head answers next to nothing."""
    torch.manual_seed(3)
    described = interface(league)
    modules = module_spec(league.training, described).build()
    with torch.no_grad():
        for module in modules.values():
            module.policy_head.weight.mul_(50)
    return described, {policy: modules[policy] for policy in described.policy_ids}


Exported = tuple[Interface, ActorCritic, Path, list[Met]]


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """A masked, convolutional policy, its graph, and observations from its environment."""
    league = tictactoe(**CONVOLVED)
    described, modules = modules_of(league)
    path = tmp_path_factory.mktemp("export") / "shared.onnx"
    export_policy(modules["shared"], described.of_policy("shared"), path)
    met = parity.gather(league.environment, described, modules, seed=1)["shared"]
    return described, modules["shared"], path, met


def prove(exported: Exported, path: Path | None = None, module: ActorCritic | None = None) -> Any:
    described, own, graph, met = exported
    return parity.prove(path or graph, "shared", module or own, met, described.of_policy("shared").action)


def copy_of(exported: Exported) -> ActorCritic:
    described, module, *_ = exported
    other = module_spec(tictactoe(**CONVOLVED).training, described).build()["shared"]
    other.set_state(module.get_state())
    return other


def check_graph(path: Path, module: ActorCritic, described: Interface, policy: str) -> onnxruntime.InferenceSession:
    """Names, dtypes and shapes are those that the manifest states, and the batch is dynamic."""
    model = onnx.load(path, load_external_data=False)
    onnx.checker.check_model(model)
    assert not any(tensor.external_data for tensor in model.graph.initializer)
    session = onnxruntime.InferenceSession(path)
    taken, answered, state = graph_tensors(module, described.of_policy(policy))
    types = {"float32": "float", "float64": "double"}
    for tensors, nodes in ((taken, session.get_inputs()), (answered, session.get_outputs())):
        assert [node.name for node in nodes] == [tensor.name for tensor in tensors]
        assert [tuple(node.shape[1:]) for node in nodes] == [tensor.shape[1:] for tensor in tensors]
        assert [node.type for node in nodes] == [f"tensor({types.get(t.dtype, t.dtype)})" for t in tensors]
        assert all(isinstance(node.shape[0], str) for node in nodes)
    assert state == tuple(tensor for tensor in taken if tensor.name.startswith("state_in_"))
    return session


def test_the_graph_is_one_file_with_the_environments_names_and_dtypes(exported: Exported) -> None:
    described, module, path, _ = exported
    session = check_graph(path, module, described, "shared")
    assert list(path.parent.iterdir()) == [path]
    assert [node.type for node in session.get_inputs()] == ["tensor(int8)", "tensor(int8)"]
    assert [node.type for node in session.get_outputs()] == ["tensor(int64)", "tensor(float)"]


def test_observations_come_from_play_and_are_enough(exported: Exported) -> None:
    *_, met = exported
    planes = np.concatenate([situation.observations["observation"] for situation in met])
    masks = np.concatenate([situation.observations["action_mask"] for situation in met])
    assert len(planes) >= 2000
    assert planes.dtype == masks.dtype == np.int8
    assert (planes.reshape(len(planes), -1).sum(-1) + masks.sum(-1) == 9).all(), "stones and free cells"
    assert len(np.unique(planes.reshape(len(planes), -1), axis=0)) > 500


def test_the_proof_holds_and_actions_are_legal_in_any_batch(exported: Exported) -> None:
    _, _, path, met = exported
    proof = prove(exported)
    assert proof.observations >= 2000
    assert proof.mismatches == 0
    assert proof.max_difference < 1e-4
    policy = OnnxPolicy(path)
    rows = {
        name: np.concatenate([situation.observations[name] for situation in met[:20]]) for name in met[0].observations
    }
    together = policy.act(rows).actions
    singly = [policy.act({name: array[i : i + 1] for name, array in rows.items()}).actions[0] for i in range(50)]
    assert together[:50].tolist() == singly
    assert (rows["action_mask"][np.arange(len(together)), together] == 1).all()


def test_a_graph_of_other_weights_is_refused(exported: Exported, tmp_path: Path) -> None:
    other = copy_of(exported)
    with torch.no_grad():
        other.policy_head.weight[4] += 2
    export_policy(other, exported[0].of_policy("shared"), tmp_path / "other.onnx")
    with pytest.raises(ParityError, match=r"differs from its module on [1-9]\d* of 2\d\d\d greedy actions"):
        prove(exported, tmp_path / "other.onnx")


def test_a_graph_that_would_explore_otherwise_is_refused(exported: Exported, tmp_path: Path) -> None:
    """The same greedy actions, at another temperature."""
    other = copy_of(exported)
    with torch.no_grad():
        other.policy_head.weight *= 2
        other.policy_head.bias *= 2
    export_policy(other, exported[0].of_policy("shared"), tmp_path / "other.onnx")
    with pytest.raises(ParityError, match="on 0 of"):
        prove(exported, tmp_path / "other.onnx")


def test_near_ties_are_counted_not_refused(exported: Exported, tmp_path: Path) -> None:
    """Two modules whose best two actions swap by less than 1e-5."""
    first, second = copy_of(exported), copy_of(exported)
    for net, bias in ((first, [4e-6, 0.0]), (second, [0.0, 4e-6])):
        with torch.no_grad():
            net.policy_head.weight.zero_()
            net.policy_head.bias.copy_(torch.tensor([*bias, *[-1.0] * 7]))
    export_policy(second, exported[0].of_policy("shared"), tmp_path / "second.onnx")
    proof = prove(exported, tmp_path / "second.onnx", first)
    masks = np.concatenate([situation.observations["action_mask"] for situation in exported[3]])
    assert proof.mismatches == 0
    assert proof.near_ties == (masks[:, :2] == 1).all(-1).sum() > 0


def test_a_network_that_has_diverged_is_refused(exported: Exported) -> None:
    diverged = copy_of(exported)
    with torch.no_grad():
        diverged.policy_head.bias.fill_(float("nan"))
    with pytest.raises(ParityError, match="diverged"):
        prove(exported, module=diverged)


def test_masked_logits_are_exported_as_they_are(exported: Exported) -> None:
    _, _, path, met = exported
    observations = met[-1].observations
    logits = OnnxPolicy(path).distribution(observations).dist_inputs
    assert ((logits == np.float32(MASKED)) == (observations["action_mask"] == 0)).all()


MPE = {"environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"continuous_actions": True, "N": 2}}}
PURSUIT = {"environment": {"entry_point": "pettingzoo.sisl.pursuit_v5", "kwargs": {"max_cycles": 20, "n_pursuers": 3}}}
LEAGUES = {
    "counting": counting([3, 5], []),
    "discrete": solvable("discrete", kwargs={"agents": 2}),
    "multi": solvable("several"),
    "box": solvable("numbers", normalize_observations=True),
    "memory": solvable("remembering", **MEMORY),
    "masked memory": tictactoe(**MEMORY, normalize_observations=True),
    "shared encoder": solvable(
        "several", kwargs={"agents": 2}, policies={"a": ["player_0"], "b": ["player_1"]}, shared_encoder=True
    ),
    "simultaneous box memory": LeagueConfig.from_mapping({"league": "mpe", **MPE, "training": MEMORY}),
    "strided": LeagueConfig.from_mapping(
        {"league": "pursuit", **PURSUIT, "training": {"convolutions": [{"filters": 3, "stride": 2}], "hidden": [8]}}
    ),
}


@pytest.mark.parametrize("league", LEAGUES.values(), ids=LEAGUES.keys())
def test_every_kind_of_policy_acts_as_its_module_does(
    league: LeagueConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parity, "OBSERVATIONS", 400)
    described, modules = modules_of(league)
    met = parity.gather(league.environment, described, modules, seed=1)
    for policy, module in modules.items():
        path, spaces = tmp_path / f"{policy}.onnx", described.of_policy(policy)
        export_policy(module, spaces, path)
        check_graph(path, module, described, policy)
        proof = parity.prove(path, policy, module, met[policy], spaces.action)
        assert proof.observations >= 400
        assert proof.mismatches == 0
        answer = OnnxPolicy(path).distribution(met[policy][0].observations)
        assert answer.dist_inputs is not None
        assert answer.dist_inputs.shape[1] == dist_inputs_size(spaces.action)
        assert all(to_gymnasium(spaces.action).contains(action) for action in answer.actions)


def test_states_are_carried_through_episodes_and_begin_anew_with_them() -> None:
    league = LEAGUES["memory"]
    described, modules = modules_of(league)
    met = parity.gather(league.environment, described, modules, seed=1)["shared"]
    begins = np.concatenate([situation.observations["observation"] != 2 for situation in met])
    for key in ("h", "c"):
        is_zero = (np.concatenate([situation.state[key] for situation in met]) == 0).all(-1)
        assert (is_zero == begins).all()
    assert 0.3 < begins.mean() < 0.4, "one of three steps"


def test_a_state_that_comes_out_otherwise_is_refused(tmp_path: Path) -> None:
    """The value of a weight that only the next step's answer would show."""
    league = LEAGUES["memory"]
    described, modules = modules_of(league)
    spaces, module = described.of_policy("shared"), modules["shared"]
    met = parity.gather(league.environment, described, modules, seed=1)["shared"]
    with torch.no_grad():
        module.policy_head.weight.zero_()
    parity_of = [tmp_path / "right.onnx", tmp_path / "wrong.onnx"]
    export_policy(module, spaces, parity_of[0])
    parity.prove(parity_of[0], "shared", module, met, spaces.action)
    assert module.memory is not None
    before = module.get_state()
    with torch.no_grad():
        module.memory.lstm.bias_ih_l0 += 0.1
    export_policy(module, spaces, parity_of[1])
    module.set_state(before)
    with pytest.raises(ParityError, match="differs from its module on 0 of"):
        parity.prove(parity_of[1], "shared", module, met, spaces.action)


@pytest.mark.parametrize("name", ["multi", "box"])
def test_an_action_that_differs_is_refused(name: str, tmp_path: Path) -> None:
    """The graph spans or shifts actions otherwise than the environment's space says."""
    league = LEAGUES[name]
    described, modules = modules_of(league)
    spaces, module = described.of_policy("shared"), modules["shared"]
    other = (
        spaces.action.model_copy(update={"start": [1, 0]})
        if isinstance(spaces.action, MultiDiscrete)
        else spaces.action.model_copy(update={"high": [2.001, 10.0]})
    )
    path = tmp_path / "other.onnx"
    export_policy(module, spaces.model_copy(update={"action": other}), path)
    met = parity.gather(league.environment, described, modules, seed=1)["shared"]
    with pytest.raises(ParityError, match=r"on [1-9]\d* of \d+ greedy actions"):
        parity.prove(path, "shared", module, met, spaces.action)


def test_a_policy_that_hardly_acts_cannot_be_proven(monkeypatch: pytest.MonkeyPatch) -> None:
    league = LEAGUES["counting"]
    described, modules = modules_of(league)
    monkeypatch.setattr(parity, "MOST_SECONDS", 0)
    with pytest.raises(ParityError, match=r"policy policy_\d met \d+ observations in \d s of play, expected 256"):
        parity.gather(league.environment, described, modules, seed=1)


def test_slow_and_large_environments_are_compared_on_fewer(monkeypatch: pytest.MonkeyPatch) -> None:
    league = LEAGUES["counting"]
    described, modules = modules_of(league)

    def compared() -> list[int]:
        met = parity.gather(league.environment, described, modules, seed=1)
        return [sum(map(len, met[policy])) for policy in described.policy_ids]

    assert min(compared()) >= 2048
    with monkeypatch.context() as patched:
        patched.setattr(parity, "ENOUGH_SECONDS", -1)
        assert 256 <= min(compared()) < 300
    monkeypatch.setattr(parity, "MEGABYTES", 0)
    assert 256 <= min(compared()) < 300
