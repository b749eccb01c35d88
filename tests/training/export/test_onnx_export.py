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
from league.spaces.conversion import to_gymnasium
from tests.support.leagues.training_leagues import counting, solvable, solvable_by_dqn, tictactoe
from training.algorithms import rllib_config
from training.algorithms.rllib_config import module_spec
from training.export import parity
from training.export.onnx_export import export_policy, graph_tensors
from training.importing.source import onnx_source
from training.modules.actor_critic import ActorCritic
from training.modules.policy_module import MASKED_LOGIT

CONVOLVED = {"convolutions": [{"filters": 4, "kernel": 2}], "hidden": [8]}
MEMORY = {"recurrence": {"width": 6}}
FEW = 256
"""Observations, which are more for a published version."""


def modules_of(league: LeagueConfig) -> tuple[Interface, dict[str, ActorCritic]]:
    """Scale up the policy heads: those of a new network give almost uniform actions."""
    torch.manual_seed(3)
    interface_of_league = interface(league)
    modules = module_spec(league.training, interface_of_league).build()
    with torch.no_grad():
        for module in modules.values():
            module.policy_head.weight.mul_(50)
    return interface_of_league, {policy: modules[policy] for policy in interface_of_league.policy_ids}


@pytest.fixture(autouse=True)
def few_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, observations=FEW))


class Played:
    """A policy of a league, and observations from its play."""

    def __init__(self, league: LeagueConfig) -> None:
        self.interface, modules = modules_of(league)
        self.module, self.spaces = modules["shared"], self.interface.of_policy("shared")
        self.observed = parity.collect_observations(league.environment, self.interface, modules, seed=1)["shared"]

    def export(self, path: Path, **changed: Any) -> None:
        export_policy(self.module, self.spaces.model_copy(update=changed), path)

    def check_parity(self, path: Path, module: ActorCritic | None = None) -> Any:
        return parity.check_parity(path, "shared", module or self.module, self.observed, self.spaces.action)

    def copied_module(self) -> ActorCritic:
        copied = module_spec(tictactoe(**CONVOLVED).training, self.interface).build()["shared"]
        copied.set_state(self.module.get_state())
        return copied


@pytest.fixture(scope="module")
def played() -> Played:
    """A masked convolutional policy, with as many observations as for a published version."""
    return Played(tictactoe(**CONVOLVED))


@pytest.fixture(scope="module")
def path(played: Played, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its graph."""
    path = tmp_path_factory.mktemp("export") / "shared.onnx"
    played.export(path)
    return path


def check_graph(
    path: Path, module: ActorCritic, interface_of_league: Interface, policy: str
) -> onnxruntime.InferenceSession:
    """The names, dtypes and shapes equal the manifest, and the batch size is dynamic."""
    model = onnx.load(path, load_external_data=False)
    onnx.checker.check_model(model)
    assert not any(tensor.external_data for tensor in model.graph.initializer)
    session = onnxruntime.InferenceSession(path)
    inputs, outputs, state = graph_tensors(module, interface_of_league.of_policy(policy))
    types = {"float32": "float", "float64": "double"}
    for tensors, nodes in ((inputs, session.get_inputs()), (outputs, session.get_outputs())):
        assert [node.name for node in nodes] == [tensor.name for tensor in tensors]
        assert [tuple(node.shape[1:]) for node in nodes] == [tensor.shape[1:] for tensor in tensors]
        assert [node.type for node in nodes] == [f"tensor({types.get(t.dtype, t.dtype)})" for t in tensors]
        assert all(isinstance(node.shape[0], str) for node in nodes)
    assert state == tuple(tensor for tensor in inputs if tensor.name.startswith("state_in_"))
    return session


def test_the_graph_is_one_file_with_the_names_and_dtypes_of_the_environment(played: Played, path: Path) -> None:
    session = check_graph(path, played.module, played.interface, "shared")
    assert list(path.parent.iterdir()) == [path]
    assert [node.type for node in session.get_inputs()] == ["tensor(int8)", "tensor(int8)"]
    assert [node.type for node in session.get_outputs()] == ["tensor(int64)", "tensor(float)"]


def test_observations_are_collected_by_play(played: Played) -> None:
    planes, masks = (
        np.concatenate([part.observations[name] for part in played.observed]) for name in ("observation", "action_mask")
    )
    assert len(planes) >= 2000
    assert planes.dtype == masks.dtype == np.int8
    assert (planes.reshape(len(planes), -1).sum(-1) + masks.sum(-1) == 9).all(), "occupied and free cells"
    assert len(np.unique(planes.reshape(len(planes), -1), axis=0)) > 500


def test_parity_holds_and_actions_are_legal_in_any_batch(played: Played, path: Path) -> None:
    proof = played.check_parity(path)
    assert (proof.observations >= 2000, proof.mismatches, proof.max_difference < 1e-4) == (True, 0, True)
    policy, parts = OnnxPolicy(path), played.observed[:20]
    rows = {name: np.concatenate([part.observations[name] for part in parts]) for name in parts[0].observations}
    together = policy.act(rows).actions
    singly = [policy.act({name: array[i : i + 1] for name, array in rows.items()}).actions[0] for i in range(50)]
    assert together[:50].tolist() == singly
    assert (rows["action_mask"][np.arange(len(together)), together] == 1).all()


def test_another_network_than_that_of_the_graph_is_rejected(played: Played, path: Path) -> None:
    other, warmer = played.copied_module(), played.copied_module()
    with torch.no_grad():
        other.policy_head.weight[4] += 2
        warmer.policy_head.weight *= 2
        warmer.policy_head.bias *= 2
    with pytest.raises(ParityError, match=r"differs from its module on [1-9]\d* of 2\d\d\d greedy actions"):
        played.check_parity(path, other)
    # The same greedy actions at another temperature.
    with pytest.raises(ParityError, match="on 0 of"):
        played.check_parity(path, warmer)
    with torch.no_grad():
        other.policy_head.bias.fill_(float("nan"))
    with pytest.raises(ParityError, match="diverged"):
        played.check_parity(path, other)


def test_near_ties_are_counted_but_accepted(played: Played, tmp_path: Path) -> None:
    """Two modules whose two best actions swap by less than 1e-5."""
    first, second = played.copied_module(), played.copied_module()
    for net, bias in ((first, [4e-6, 0.0]), (second, [0.0, 4e-6])):
        with torch.no_grad():
            net.policy_head.weight.zero_()
            net.policy_head.bias.copy_(torch.tensor([*bias, *[-1.0] * 7]))
    export_policy(second, played.spaces, tmp_path / "second.onnx")
    proof = played.check_parity(tmp_path / "second.onnx", first)
    masks = np.concatenate([part.observations["action_mask"] for part in played.observed])
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


def test_masked_logits_are_exported_unchanged(played: Played, path: Path) -> None:
    observations = played.observed[-1].observations
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
        assert (proof.observations >= FEW, proof.mismatches) == (True, 0)
        answer = OnnxPolicy(path).distribution(observed[policy][0].observations)
        assert answer.dist_inputs is not None
        assert answer.dist_inputs.shape[1] == dist_inputs_size(spaces.action)
        assert all(to_gymnasium(spaces.action).contains(action) for action in answer.actions)


def test_states_are_carried_through_episodes_and_reset_between_them() -> None:
    observed = Played(LEAGUES["memory"]).observed
    begins = np.concatenate([part.observations["observation"] != 2 for part in observed])
    for key in ("h", "c"):
        is_zero = (np.concatenate([part.state[key] for part in observed]) == 0).all(-1)
        assert (is_zero == begins).all()
    assert 0.3 < begins.mean() < 0.4, "a third of the steps starts an episode"


def test_a_graph_with_another_state_is_rejected(tmp_path: Path) -> None:
    """A weight differs that affects only the next step."""
    played, path = Played(LEAGUES["memory"]), tmp_path / "shared.onnx"
    with torch.no_grad():
        played.module.policy_head.weight.zero_()
    played.export(path)
    played.check_parity(path)
    assert played.module.recurrent is not None
    with torch.no_grad():
        played.module.recurrent.lstm.bias_ih_l0 += 0.1
    with pytest.raises(ParityError, match="differs from its module on 0 of"):
        played.check_parity(path)


@pytest.mark.parametrize(("name", "changed"), [("multi", {"start": [1, 0]}), ("box", {"high": [2.001, 10.0]})])
def test_a_graph_with_other_actions_is_rejected(name: str, changed: dict[str, Any], tmp_path: Path) -> None:
    """The graph scales or shifts actions differently from the action space."""
    played, path = Played(LEAGUES[name]), tmp_path / "other.onnx"
    played.export(path, action=played.spaces.action.model_copy(update=changed))
    with pytest.raises(ParityError, match=r"on [1-9]\d* of \d+ greedy actions"):
        played.check_parity(path)


def test_a_policy_that_rarely_acts_cannot_be_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    league = LEAGUES["counting"]
    interface_of_league, modules = modules_of(league)
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, most_seconds=0))
    with pytest.raises(ParityError, match=r"policy policy_\d received \d+ observations in \d s of play, expected 256"):
        parity.collect_observations(league.environment, interface_of_league, modules, seed=1)


def test_slow_and_large_environments_are_compared_on_fewer_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    league = LEAGUES["counting"]
    interface_of_league, modules = modules_of(league)
    limits = replace(parity.EXPORTED, observations=400)
    for changed, least, most in (({}, 400, 999), ({"enough_seconds": -1}, 256, 300), ({"megabytes": 0}, 256, 300)):
        monkeypatch.setattr(parity, "EXPORTED", replace(limits, **changed))
        observed = parity.collect_observations(league.environment, interface_of_league, modules, seed=1)
        assert least <= min(sum(map(len, batches)) for batches in observed.values()) < most
