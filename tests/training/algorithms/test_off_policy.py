"""What DQN, QMIX and MADDPG have in common: they learn, continue from a checkpoint, and export what acts."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import maddpg, solvable_by_dqn
from tests.support.leagues.training_leagues import qmix_league as qmix
from tests.support.off_policy import build, learns, train
from training.algorithms.off_policy import OffPolicy, starts_with_empty_replay
from training.algorithms.rllib_config import algorithm_config, module_spec
from training.export import parity
from training.export.onnx_export import export_policy, graph_tensors, state_names
from training.learners import dqn as dqn_learner
from training.learners import qmix as qmix_learner
from training.learners.off_policy import next_actions
from training.modules.policy_module import MASKED_LOGIT
from training.sampling.closed_transitions import TERMINATED, TRUNCATED, JointTransitions, PolicyTransitions

pytestmark = pytest.mark.usefixtures("ray_session")
slow = pytest.mark.slow
dqn = solvable_by_dqn

OWN = {"a": ["player_0"], "b": ["player_1"]}
OPPOSED = {"agents": 2, "opposed": True}
MEMORY = {"recurrence": {"width": 16, "sequence": 3}, "batch_size": 32, "hidden": [16]}
ALL_EXTENSIONS = {"n_step": 3, "priorities": {}, "noisy": True, "distributional": {"low": -1, "high": 5}}
TEAMS = {"groups": {"one": ["player_0"], "other": ["player_1", "player_2"]}}
TASK = {"shared": 0.9 * ROUNDS}
EACH = dict.fromkeys(OWN, 0.85 * ROUNDS)
OPPOSITES = {"a": 0.85 * ROUNDS, "b": -0.15 * ROUNDS}


@slow
@pytest.mark.parametrize(
    ("league", "target", "updates"),
    [
        pytest.param(dqn("discrete"), TASK, 9, id="dqn"),
        pytest.param(dqn("discrete", double=False, dueling=False), TASK, 9, id="dqn, single"),
        pytest.param(dqn("discrete", **ALL_EXTENSIONS), TASK, 9, id="dqn, all extensions"),
        pytest.param(dqn("discrete", target_every=1, target_rate=0.02), TASK, 9, id="dqn, Polyak"),
        pytest.param(dqn("discrete", OPPOSED, OWN), OPPOSITES, 10, id="dqn, opposed tasks"),
        pytest.param(qmix("discrete", {"agents": 2}, OWN), EACH, 14, id="qmix"),
        pytest.param(qmix("discrete", {"agents": 2}, OWN, mixer="vdn"), EACH, 14, id="vdn"),
        pytest.param(qmix("discrete", {"agents": 2}, OWN, mixer="none"), EACH, 14, id="independent values"),
        pytest.param(
            qmix("discrete", OPPOSED | {"agents": 3}, {"a": ["player_0"], "b": ["*"]}, **TEAMS),
            OPPOSITES,
            14,
            id="qmix, competing teams",
        ),
    ],
)
def test_it_learns(league: LeagueConfig, target: dict[str, float], updates: int) -> None:
    assert learns(league, target, updates)


@slow
@pytest.mark.parametrize("algorithm", [dqn, qmix])
def test_remembering_requires_recurrence(algorithm: Callable[..., LeagueConfig]) -> None:
    settings = {"gamma": 0.99, "num_envs": 8, "exploration": {"steps": 8000}}
    assert learns(algorithm("remembering", **settings, **MEMORY), {"shared": 0.8}, 14)
    assert not learns(algorithm("remembering", **settings), {"shared": 0.5}, 14)


def check_values(league: LeagueConfig) -> None:
    """The value of the state is that of an endless episode, as truncation is bootstrapped. The large value of an
    illegal action is ignored.
    """

    def inspect_algorithm(algorithm: OffPolicy, _: Any) -> NDArray:
        learner = algorithm.learner_group._learner
        for network in (learner.module["shared"], learner.targets["shared"]):
            with torch.no_grad():
                (network.advantages if league.training.algorithm == "dqn" else network.head).bias[1] += 1000.0
        for _ in range(10):
            algorithm.train()
        module = learner.module["shared"]
        observation = {"observation": torch.ones(1, 1), "action_mask": torch.tensor([[1, 0, 1]])}
        state = {key: torch.as_tensor(value)[None] for key, value in module.get_initial_state().items()}
        outputs = module.forward_inference({"obs": observation, "state_in": state})
        return outputs["action_dist_inputs"].numpy()[0]

    values = train(league, 1, inspect_algorithm)
    assert values[1] == MASKED_LOGIT
    np.testing.assert_allclose(values[[0, 2]], 1 / (1 - league.training.gamma), rtol=0.1)


HALF = {"exploration": {"initial": 0.5, "final": 0.5}}
VDN = {"mixer": "vdn"} | HALF


@pytest.mark.parametrize(
    "league",
    [
        pytest.param(dqn("masked", n_step=3, **HALF), id="dqn, three steps"),
        pytest.param(dqn("masked", **HALF), marks=slow, id="dqn"),
        pytest.param(qmix("masked", n_step=3, **VDN), id="vdn, three steps"),
        pytest.param(qmix("masked", **VDN), marks=slow, id="vdn"),
        pytest.param(qmix("masked", double=False, **VDN), marks=slow, id="vdn, single"),
        pytest.param(qmix("masked", gamma=0.5, **VDN, **MEMORY), marks=slow, id="vdn, recurrent"),
    ],
)
def test_values_bootstrap_truncation_and_ignore_illegal_actions(league: LeagueConfig) -> None:
    check_values(league)


@slow
@pytest.mark.parametrize("fault", ["truncation is termination", "targets without a mask"])
@pytest.mark.parametrize("algorithm", ["dqn", "vdn"])
def test_the_check_of_values_detects(algorithm: str, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    transitions: Any = PolicyTransitions if algorithm == "dqn" else JointTransitions
    cut, suffix = transitions.cut, "" if algorithm == "dqn" else "/shared"

    def as_terminated(self: Any) -> Any:
        blocks = cut(self)
        for block in blocks.values():
            block.rows[TERMINATED + suffix] = block.rows[TERMINATED + suffix] | block.rows[TRUNCATED + suffix]
        return blocks

    if fault == "truncation is termination":
        monkeypatch.setattr(transitions, "cut", as_terminated)
    else:
        learner = dqn_learner if algorithm == "dqn" else qmix_learner
        monkeypatch.setattr(learner, "next_actions", lambda online, target, _: next_actions(online, target, None))
    with pytest.raises(AssertionError):
        check_values(dqn("masked", **HALF) if algorithm == "dqn" else qmix("masked", **VDN))


@pytest.mark.parametrize(
    "league",
    [
        pytest.param(dqn("discrete", replay_capacity=900, **ALL_EXTENSIONS), id="dqn, all extensions"),
        pytest.param(dqn("discrete", replay_capacity=900, **MEMORY), marks=slow, id="dqn, recurrent"),
        pytest.param(
            qmix("discrete", {"agents": 2}, replay_capacity=700, normalize_observations=True), id="qmix, normalised"
        ),
        pytest.param(qmix("discrete", {"agents": 2}, replay_capacity=700, **MEMORY), marks=slow, id="qmix, recurrent"),
        pytest.param(maddpg("summing", {"ends": 2}, OWN, theta=0.15, priorities={}, n_step=2), id="maddpg"),
    ],
)
def test_a_restored_algorithm_continues_identically(league: LeagueConfig, tmp_path: Path) -> None:
    """Networks, targets, optimizers, replay and counters, compared with an algorithm that continues."""

    def state_after(algorithm: OffPolicy) -> dict[str, Any]:
        algorithm.reset_episodes(2048)
        for _ in range(2):
            algorithm.train()
        learner = algorithm._learner
        state: dict[str, Any] = {"updates": learner.updates, "steps": algorithm.steps, "noise": algorithm.exploration}
        for kind, networks in (("network", learner.networks), ("target", learner.targets)):
            for name, network in networks.items():
                state |= {f"{kind} {name} {key}": value.numpy().copy() for key, value in network.state_dict().items()}
        for name, optimizer in learner._named_optimizers.items():
            for index, moments in optimizer.state_dict()["state"].items():
                state |= {f"{name} {index} {key}": torch.as_tensor(value).numpy() for key, value in moments.items()}
        for name, replay in algorithm.replays.items():
            state |= {f"replay {name} {key}": column for key, column in replay.sample(64).rows.items()}
        return state

    def save(algorithm: OffPolicy, _: Any) -> dict[str, Any]:
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        return state_after(algorithm)

    expected = train(league, 2, save)
    assert expected["updates"] > 20
    torch.manual_seed(77)
    restored = build(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        state = state_after(restored)
    finally:
        restored.stop()
    assert state.keys() == expected.keys()
    assert [name for name, value in expected.items() if not np.array_equal(state[name], value)] == []


@pytest.mark.parametrize("settings", [{"replay_in_checkpoint": False}, {"replay_capacity": 5000}])
def test_a_buffer_that_is_not_saved_or_has_another_capacity_is_empty_after_restoring(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    league = dqn("discrete")
    train(league, 1, lambda algorithm, _: algorithm.save_to_path(str(tmp_path / "checkpoint")))
    assert not starts_with_empty_replay(league.training, tmp_path / "checkpoint")
    assert starts_with_empty_replay(league.with_training(**settings).training, tmp_path / "checkpoint")
    restored = build(league.with_training(**settings))
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        assert (len(restored.replays["shared"]), restored.steps) == (0, 1024)
    finally:
        restored.stop()


@pytest.mark.parametrize(
    "league",
    [
        pytest.param(dqn("masked"), marks=slow, id="dqn"),
        pytest.param(dqn("masked", **ALL_EXTENSIONS), id="dqn, all extensions"),
        pytest.param(dqn("masked", **MEMORY), marks=slow, id="dqn, recurrent"),
        pytest.param(qmix("masked"), marks=slow, id="qmix"),
        pytest.param(qmix("masked", **MEMORY), id="qmix, recurrent"),
        pytest.param(maddpg("numbers", {}, {"shared": ["*"]}), id="maddpg, numbers"),
        pytest.param(maddpg("several", {"agents": 2}, {"shared": ["*"]}), marks=slow, id="maddpg, several"),
        pytest.param(maddpg("discrete", {"agents": 2}, {"shared": ["*"]}), marks=slow, id="maddpg, discrete"),
        pytest.param(maddpg("masked", {}, {"shared": ["*"]}), marks=slow, id="maddpg, masked"),
    ],
)
def test_the_graph_equals_the_module_and_depends_on_its_own_observation_only(
    league: LeagueConfig, tmp_path: Path
) -> None:
    game, masked = interface(league), league.league == "masked"
    spaces, graph = game.of_policy("shared"), tmp_path / "shared.onnx"
    torch.manual_seed(1)
    modules = module_spec(league.training, game).build()
    assert set(modules.keys()) == {"shared"}, "mixers and critics are not exported"
    module = modules["shared"]
    if league.training.algorithm == "maddpg":
        with torch.no_grad():
            module.head.weight.mul_(50)
        module.exploration = 0.25
    inputs, _, state = graph_tensors(module, spaces)
    names = {tensor.name for tensor in inputs} - {tensor.name for tensor in state}
    assert names == {"observation"} | ({"action_mask"} if masked else set())
    export_policy(module, spaces, graph)
    observed = parity.collect_observations(league.environment, game, {"shared": module}, seed=1)["shared"]
    proof = parity.check_parity(graph, "shared", module, observed, spaces.action)
    assert proof.observations >= 2048
    assert (proof.mismatches, proof.max_difference < 1e-4) == (0, True)
    if masked:
        first = observed[0]
        states = dict(zip(state_names(first.state), first.state.values(), strict=True)) or None
        outputs = OnnxPolicy(graph).distribution(first.observations, state=states)
        assert (outputs.dist_inputs[:, 1] == np.float32(MASKED_LOGIT)).all()
        assert (outputs.actions != 1).all()
    if league.league == "numbers":
        dist_inputs, _ = parity.module_outputs(module, observed[0])
        assert np.exp(dist_inputs[:, 2:]) == pytest.approx(0.25), "exploration noise is exported"
        assert np.abs(dist_inputs[:, :2]).max() <= 1


@pytest.mark.parametrize(
    ("league", "message"),
    [
        (dqn("numbers"), r"policies\.shared: dqn needs Discrete actions, got .*: train it with"),
        (qmix("numbers"), r"training\.groups\.team: qmix needs Discrete actions, but player_0 has"),
        (
            maddpg("discrete", {"agents": 2}, OWN, opponents=["script:random"]),
            r"training\.opponents.*observations and actions of all agents",
        ),
    ],
    ids=["dqn", "qmix", "maddpg"],
)
def test_what_it_cannot_learn_is_rejected(league: LeagueConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        algorithm_config(league, interface(league))
