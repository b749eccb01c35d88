from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ParityError
from league.interface import Interface
from league.policies.actions import dist_inputs_size
from league.policies.onnx import OnnxPolicy
from league.spaces import MultiDiscrete
from league.spaces.conversion import to_gymnasium
from tests.support.leagues.training_leagues import counting, solvable, solvable_by_dqn, tictactoe
from training.algorithms import rllib_config
from training.algorithms.rllib_config import module_spec
from training.export import parity
from training.export.onnx_export import export_policy, graph_tensors
from training.export.parity import ObservedBatch
from training.importing.source import onnx_source
from training.modules.actor_critic import ActorCritic
from training.modules.policy_module import MASKED_LOGIT

CONVOLVED = {"convolutions": [{"filters": 4, "kernel": 2}], "hidden": [8]}
MEMORY = {"recurrence": {"width": 6}}


def modules_of(league: LeagueConfig) -> tuple[Interface, dict[str, ActorCritic]]:
    """Scale up the policy heads: those of a new network give almost uniform actions."""
    torch.manual_seed(3)
    interface_of_league = interface(league)
    modules = module_spec(league.training, interface_of_league).build()
    with torch.no_grad():
        for module in modules.values():
            module.policy_head.weight.mul_(50)
    return interface_of_league, {policy: modules[policy] for policy in interface_of_league.policy_ids}


Exported = tuple[Interface, ActorCritic, Path, list[ObservedBatch]]


@pytest.fixture(autouse=True)
def few_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer than for a published version. `exported` has as many as that."""
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, observations=400))


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    """A masked convolutional policy, its graph, and observations from its environment."""
    league = tictactoe(**CONVOLVED)
    interface_of_league, modules = modules_of(league)
    path = tmp_path_factory.mktemp("export") / "shared.onnx"
    export_policy(modules["shared"], interface_of_league.of_policy("shared"), path)
    observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)["shared"]
    return interface_of_league, modules["shared"], path, observed


def check_parity(exported: Exported, path: Path | None = None, module: ActorCritic | None = None) -> Any:
    interface_of_league, own, graph, observed = exported
    return parity.check_parity(
        path or graph, "shared", module or own, observed, interface_of_league.of_policy("shared").action
    )


def copy_of(exported: Exported) -> ActorCritic:
    interface_of_league, module, *_ = exported
    other = module_spec(tictactoe(**CONVOLVED).training, interface_of_league).build()["shared"]
    other.set_state(module.get_state())
    return other


def check_graph(
    path: Path, module: ActorCritic, interface_of_league: Interface, policy: str
) -> onnxruntime.InferenceSession:
    """The names, dtypes and shapes equal the manifest, and the batch size is dynamic."""
    model = onnx.load(path, load_external_data=False)
    onnx.checker.check_model(model)
    assert not any(tensor.external_data for tensor in model.graph.initializer)
    session = onnxruntime.InferenceSession(path)
    taken, answered, state = graph_tensors(module, interface_of_league.of_policy(policy))
    types = {"float32": "float", "float64": "double"}
    for tensors, nodes in ((taken, session.get_inputs()), (answered, session.get_outputs())):
        assert [node.name for node in nodes] == [tensor.name for tensor in tensors]
        assert [tuple(node.shape[1:]) for node in nodes] == [tensor.shape[1:] for tensor in tensors]
        assert [node.type for node in nodes] == [f"tensor({types.get(t.dtype, t.dtype)})" for t in tensors]
        assert all(isinstance(node.shape[0], str) for node in nodes)
    assert state == tuple(tensor for tensor in taken if tensor.name.startswith("state_in_"))
    return session


def test_the_graph_is_one_file_with_the_names_and_dtypes_of_the_environment(exported: Exported) -> None:
    interface_of_league, module, path, _ = exported
    session = check_graph(path, module, interface_of_league, "shared")
    assert list(path.parent.iterdir()) == [path]
    assert [node.type for node in session.get_inputs()] == ["tensor(int8)", "tensor(int8)"]
    assert [node.type for node in session.get_outputs()] == ["tensor(int64)", "tensor(float)"]


def test_observations_are_collected_by_play(exported: Exported) -> None:
    *_, observed = exported
    planes = np.concatenate([part.observations["observation"] for part in observed])
    masks = np.concatenate([part.observations["action_mask"] for part in observed])
    assert len(planes) >= 2000
    assert planes.dtype == masks.dtype == np.int8
    assert (planes.reshape(len(planes), -1).sum(-1) + masks.sum(-1) == 9).all(), "occupied and free cells"
    assert len(np.unique(planes.reshape(len(planes), -1), axis=0)) > 500


def test_parity_holds_and_actions_are_legal_in_any_batch(exported: Exported) -> None:
    _, _, path, observed = exported
    parity_result = check_parity(exported)
    assert parity_result.observations >= 2000
    assert parity_result.mismatches == 0
    assert parity_result.max_difference < 1e-4
    policy = OnnxPolicy(path)
    rows = {
        name: np.concatenate([part.observations[name] for part in observed[:20]]) for name in observed[0].observations
    }
    together = policy.act(rows).actions
    singly = [policy.act({name: array[i : i + 1] for name, array in rows.items()}).actions[0] for i in range(50)]
    assert together[:50].tolist() == singly
    assert (rows["action_mask"][np.arange(len(together)), together] == 1).all()


def test_another_network_than_that_of_the_graph_is_rejected(exported: Exported) -> None:
    other = copy_of(exported)
    with torch.no_grad():
        other.policy_head.weight[4] += 2
    with pytest.raises(ParityError, match=r"differs from its module on [1-9]\d* of 2\d\d\d greedy actions"):
        check_parity(exported, module=other)
    warmer = copy_of(exported)  # the same greedy actions at another temperature
    with torch.no_grad():
        warmer.policy_head.weight *= 2
        warmer.policy_head.bias *= 2
    with pytest.raises(ParityError, match="on 0 of"):
        check_parity(exported, module=warmer)
    with torch.no_grad():
        other.policy_head.bias.fill_(float("nan"))
    with pytest.raises(ParityError, match="diverged"):
        check_parity(exported, module=other)


def test_near_ties_are_counted_but_accepted(exported: Exported, tmp_path: Path) -> None:
    """Two modules whose two best actions swap by less than 1e-5."""
    first, second = copy_of(exported), copy_of(exported)
    for net, bias in ((first, [4e-6, 0.0]), (second, [0.0, 4e-6])):
        with torch.no_grad():
            net.policy_head.weight.zero_()
            net.policy_head.bias.copy_(torch.tensor([*bias, *[-1.0] * 7]))
    export_policy(second, exported[0].of_policy("shared"), tmp_path / "second.onnx")
    proof = check_parity(exported, tmp_path / "second.onnx", first)
    masks = np.concatenate([part.observations["action_mask"] for part in exported[3]])
    assert proof.mismatches == 0
    assert proof.near_ties == (masks[:, :2] == 1).all(-1).sum() > 0


@pytest.mark.slow
def test_near_ties_are_accepted_if_the_previous_action_is_an_input(tmp_path: Path) -> None:
    """The state after a near tie contains one or the other action."""
    league = solvable_by_dqn("masked", **MEMORY)
    interface_of_league = interface(league)
    spaces = interface_of_league.of_policy("shared")
    first, second = (rllib_config.module_spec(league.training, interface_of_league).build()["shared"] for _ in range(2))
    second.set_state(first.get_state())
    for net, better in ((first, 0), (second, 2)):
        with torch.no_grad():
            net.advantages.weight.zero_()
            net.advantages.bias.zero_()
            net.advantages.bias[better] = 4e-6
    export_policy(second, spaces, tmp_path / "second.onnx")
    observed = parity.collect_observations(league.environment, interface_of_league, {"shared": first}, seed=1)["shared"]
    proof = parity.check_parity(tmp_path / "second.onnx", "shared", first, observed, spaces.action)
    assert proof.mismatches == 0
    assert proof.near_ties > 0


def test_masked_logits_are_exported_unchanged(exported: Exported) -> None:
    _, _, path, observed = exported
    observations = observed[-1].observations
    logits = OnnxPolicy(path).distribution(observations).dist_inputs
    assert ((logits == np.float32(MASKED_LOGIT)) == (observations["action_mask"] == 0)).all()


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


COVERED_BY_OTHERS = ("multi", "box", "memory")
"""Kinds whose parts are all in `shared encoder`, `simultaneous box memory` and `masked memory`."""


@pytest.mark.parametrize(
    "league",
    [
        pytest.param(league, id=kind, marks=[pytest.mark.slow] if kind in COVERED_BY_OTHERS else [])
        for kind, league in LEAGUES.items()
    ],
)
def test_each_kind_of_policy_equals_its_module(league: LeagueConfig, tmp_path: Path) -> None:
    interface_of_league, modules = modules_of(league)
    observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)
    for policy, module in modules.items():
        path, spaces = tmp_path / f"{policy}.onnx", interface_of_league.of_policy(policy)
        export_policy(module, spaces, path)
        check_graph(path, module, interface_of_league, policy)
        onnx_source(path, None, spaces, {})  # it can be imported: time and memory are bounded
        proof = parity.check_parity(path, policy, module, observed[policy], spaces.action)
        assert proof.observations >= 400
        assert proof.mismatches == 0
        answer = OnnxPolicy(path).distribution(observed[policy][0].observations)
        assert answer.dist_inputs is not None
        assert answer.dist_inputs.shape[1] == dist_inputs_size(spaces.action)
        assert all(to_gymnasium(spaces.action).contains(action) for action in answer.actions)


def test_states_are_carried_through_episodes_and_reset_between_them() -> None:
    league = LEAGUES["memory"]
    interface_of_league, modules = modules_of(league)
    observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)["shared"]
    begins = np.concatenate([part.observations["observation"] != 2 for part in observed])
    for key in ("h", "c"):
        is_zero = (np.concatenate([part.state[key] for part in observed]) == 0).all(-1)
        assert (is_zero == begins).all()
    assert 0.3 < begins.mean() < 0.4, "a third of the steps starts an episode"


def test_a_graph_with_another_state_is_rejected(tmp_path: Path) -> None:
    """A weight differs that affects only the next step."""
    league, path = LEAGUES["memory"], tmp_path / "shared.onnx"
    interface_of_league, modules = modules_of(league)
    spaces, module = interface_of_league.of_policy("shared"), modules["shared"]
    observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)["shared"]
    with torch.no_grad():
        module.policy_head.weight.zero_()
    export_policy(module, spaces, path)
    parity.check_parity(path, "shared", module, observed, spaces.action)
    assert module.recurrent is not None
    with torch.no_grad():
        module.recurrent.lstm.bias_ih_l0 += 0.1
    with pytest.raises(ParityError, match="differs from its module on 0 of"):
        parity.check_parity(path, "shared", module, observed, spaces.action)


@pytest.mark.parametrize("name", ["multi", "box"])
def test_a_graph_with_other_actions_is_rejected(name: str, tmp_path: Path) -> None:
    """The graph scales or shifts actions differently from the action space."""
    league = LEAGUES[name]
    interface_of_league, modules = modules_of(league)
    spaces, module = interface_of_league.of_policy("shared"), modules["shared"]
    other = (
        spaces.action.model_copy(update={"start": [1, 0]})
        if isinstance(spaces.action, MultiDiscrete)
        else spaces.action.model_copy(update={"high": [2.001, 10.0]})
    )
    path = tmp_path / "other.onnx"
    export_policy(module, spaces.model_copy(update={"action": other}), path)
    observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)["shared"]
    with pytest.raises(ParityError, match=r"on [1-9]\d* of \d+ greedy actions"):
        parity.check_parity(path, "shared", module, observed, spaces.action)


def test_a_policy_that_rarely_acts_cannot_be_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    league = LEAGUES["counting"]
    interface_of_league, modules = modules_of(league)
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, most_seconds=0))
    with pytest.raises(ParityError, match=r"policy policy_\d received \d+ observations in \d s of play, expected 256"):
        parity.collect_observations(league.environment, interface_of_league, modules, seed=1)


def test_slow_and_large_environments_are_compared_on_fewer_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    league = LEAGUES["counting"]
    interface_of_league, modules = modules_of(league)

    def counts() -> list[int]:
        observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)
        return [sum(map(len, observed[policy])) for policy in interface_of_league.policy_ids]

    assert min(counts()) >= parity.EXPORTED.observations
    with monkeypatch.context() as patched:
        patched.setattr(parity, "EXPORTED", replace(parity.EXPORTED, enough_seconds=-1))
        assert 256 <= min(counts()) < 300
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, megabytes=0))
    assert 256 <= min(counts()) < 300
