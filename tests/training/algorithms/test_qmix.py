"""QMIX in this process: it solves what a sum of values cannot represent, and continues exactly from its checkpoint."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ray.rllib.utils.metrics import LEARNER_RESULTS

from benchmarks.training import two_step
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import solvable_by_dqn
from tests.support.off_policy import build, learns, train
from training.algorithms.off_policy import OffPolicy
from training.algorithms.rllib_config import algorithm_config, module_spec
from training.export import parity
from training.export.onnx_export import export_policy, graph_tensors, state_names
from training.learners import qmix as learning
from training.learners.off_policy import next_actions
from training.modules.policy_module import MASKED_LOGIT, PREVIOUS_ACTION
from training.modules.qmix import MonotonicMixer
from training.sampling.closed_transitions import JOINT, PRESENT, STATE, TERMINATED, TRUNCATED, JointTransitions

pytestmark = pytest.mark.usefixtures("ray_session")
MEMORY = {"recurrence": {"width": 16, "sequence": 3}, "batch_size": 32, "hidden": [16]}


def qmix_league(name: str, kwargs: dict[str, Any] | None = None, policies: Any = None, **training: Any) -> LeagueConfig:
    """An environment of `tests.support.environments.training_environments`, with all agents in one team."""
    settings = {"algorithm": "qmix", "groups": {"team": ["*"]}, "mixing_width": 8}
    return solvable_by_dqn(name, kwargs, policies, **(settings | training))


@pytest.mark.slow
def test_the_two_step_game_is_solved_exactly() -> None:
    """One seed of `benchmarks.learning two_step_game`."""
    learned = two_step.learn("qmix", seed=0)
    assert learned.returned == 8
    assert learned.error(gamma=0.99) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("mixer", ["vdn", "none"])
def test_additive_and_independent_values_choose_the_safe_game(mixer: str) -> None:
    """Negative controls: additive and independent values do not choose the game with the return 8."""
    learned = two_step.learn(mixer, seed=0, steps=12_000)
    assert learned.returned == 7
    assert learned.error(gamma=0.99) > 1


@pytest.mark.slow
@pytest.mark.parametrize("mixer", ["qmix", "vdn", "none"])
def test_agents_of_a_team_with_separate_networks_learn(mixer: str) -> None:
    policies = {"a": ["player_0"], "b": ["player_1"]}
    league = qmix_league("discrete", {"agents": 2}, policies, mixer=mixer)
    assert learns(league, dict.fromkeys(policies, 0.85 * ROUNDS), 14)


@pytest.mark.slow
def test_competing_teams_learn_opposed_tasks() -> None:
    groups = {"one": ["player_0"], "other": ["player_1", "player_2"]}
    league = qmix_league("discrete", {"agents": 3, "opposed": True}, {"a": ["player_0"], "b": ["*"]}, groups=groups)
    assert learns(league, {"a": 0.85 * ROUNDS, "b": -0.15 * ROUNDS}, 14)


@pytest.mark.slow
def test_remembering_requires_recurrence() -> None:
    settings = {"gamma": 0.99, "num_envs": 8, "exploration": {"steps": 8000}}
    assert learns(qmix_league("remembering", **settings, **MEMORY), {"shared": 0.8}, 14)
    assert not learns(qmix_league("remembering", **settings), {"shared": 0.5}, 14)


def test_the_recurrent_state_has_the_drawn_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    """While exploring, drawn actions differ from the greedy ones."""
    algorithm = build(qmix_league("discrete", exploration={"initial": 1.0, "final": 1.0}, num_envs=4, **MEMORY))
    play = algorithm.env_runner_group.local_env_runner._play
    drawn, stored = [], []
    act = play.recorder.act

    def record(policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Any) -> None:
        drawn.append(raw.tolist())
        stored.append(state[PREVIOUS_ACTION].ravel().tolist())
        act(policy, raw, log_p, dist_inputs, state)

    try:
        monkeypatch.setattr(play.recorder, "act", record)
        algorithm.train()
    finally:
        algorithm.stop()
    assert len({tuple(row) for row in drawn}) > 10
    for step, rows in enumerate(stored):
        assert rows == ([0.0] * 4 if step % ROUNDS == 0 else [action + 1.0 for action in drawn[step - 1]])


def check_values(gamma: float = 0.9, **settings: Any) -> None:
    """The value of the state is that of an endless episode, as truncation is bootstrapped. The large value of an
    illegal action is ignored.
    """
    league = qmix_league("masked", gamma=gamma, exploration={"initial": 0.5, "final": 0.5}, mixer="vdn", **settings)

    def inspect_algorithm(algorithm: OffPolicy, _: Any) -> NDArray:
        learner = algorithm.learner_group._learner
        for network in (learner.module["shared"], learner.targets["shared"]):
            with torch.no_grad():
                network.head.bias[1] += 1000.0
        for _ in range(10):
            algorithm.train()
        module = learner.module["shared"]
        seen = {"observation": torch.ones(1, 1), "action_mask": torch.tensor([[1, 0, 1]])}
        state = {key: torch.as_tensor(value)[None] for key, value in module.get_initial_state().items()}
        return module.forward_inference({"obs": seen, "state_in": state})["action_dist_inputs"].numpy()[0]

    found = train(league, 1, inspect_algorithm)
    assert found[1] == MASKED_LOGIT
    np.testing.assert_allclose(found[[0, 2]], 1 / (1 - gamma), rtol=0.1)


@pytest.mark.parametrize(
    "settings",
    [
        {"n_step": 3},
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"double": False}, marks=pytest.mark.slow),
        pytest.param({"gamma": 0.5} | MEMORY, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_values_bootstrap_truncation_and_ignore_illegal_actions(settings: dict[str, Any]) -> None:
    check_values(**settings)


@pytest.mark.slow
def test_the_check_detects_truncation_treated_as_termination(monkeypatch: pytest.MonkeyPatch) -> None:
    cut = JointTransitions.cut

    def as_terminated(self: JointTransitions) -> Any:
        blocks = cut(self)
        for block in blocks.values():
            block.rows[f"{TERMINATED}/shared"] = block.rows[f"{TERMINATED}/shared"] | block.rows[f"{TRUNCATED}/shared"]
        return blocks

    monkeypatch.setattr(JointTransitions, "cut", as_terminated)
    with pytest.raises(AssertionError):
        check_values()


@pytest.mark.slow
def test_the_check_detects_targets_without_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "next_actions", lambda online, target, _: next_actions(online, target, None))
    with pytest.raises(AssertionError):
        check_values()


@pytest.mark.parametrize(
    "settings",
    [{"normalize_observations": True}, pytest.param(MEMORY, marks=pytest.mark.slow)],
    ids=["normalised", "memory"],
)
def test_a_restored_algorithm_continues_identically(settings: dict[str, Any], tmp_path: Path) -> None:
    """Compares an algorithm that continues after its checkpoint with a restored one: agents, mixers, targets and
    buffer.
    """
    league = qmix_league("discrete", {"agents": 2}, replay_capacity=700, **settings)

    def state_after(algorithm: OffPolicy) -> list[NDArray]:
        algorithm.reset_episodes(2048)
        for _ in range(2):
            algorithm.train()
        learner = algorithm.learner_group._learner
        networks = [*learner.networks.values(), *learner.targets.values()]
        assert len(networks) == 4
        kept = algorithm.replays[JOINT].sample(64).rows.values()
        return [tensor.numpy().copy() for each in networks for tensor in each.state_dict().values()] + list(kept)

    def save(algorithm: OffPolicy, _: Any) -> list[NDArray]:
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        return state_after(algorithm)

    expected = train(league, 2, save)
    torch.manual_seed(77)
    restored = build(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        found = state_after(restored)
    finally:
        restored.stop()
    for before, now in zip(expected, found, strict=True):
        np.testing.assert_array_equal(before, now)


@pytest.mark.parametrize("settings", [{}, MEMORY], ids=["feed-forward", "memory"])
def test_an_exported_policy_depends_on_its_own_observation_only(settings: dict[str, Any], tmp_path: Path) -> None:
    league = qmix_league("masked", **settings)
    interface_of_league = interface(league)
    spaces = interface_of_league.of_policy("shared")
    modules = module_spec(league.training, interface_of_league).build()
    assert set(modules.keys()) == {"shared"}, "mixers are not exported"
    module = modules["shared"]
    taken, _, state = graph_tensors(module, spaces)
    assert {tensor.name for tensor in taken} - {tensor.name for tensor in state} == {"observation", "action_mask"}
    export_policy(module, spaces, tmp_path / "shared.onnx")
    met = parity.collect_observations(league.environment, interface_of_league, {"shared": module}, seed=1)["shared"]
    proof = parity.check_parity(tmp_path / "shared.onnx", "shared", module, met, spaces.action)
    assert (proof.mismatches, proof.max_difference < 1e-5) == (0, True)
    recurrent = dict(zip(state_names(met[0].state), met[0].state.values(), strict=True))
    graph = OnnxPolicy(tmp_path / "shared.onnx").distribution(met[0].observations, state=recurrent or None)
    assert (graph.actions != 1).all()


def test_frozen_policies_do_not_change() -> None:
    policies = {"a": ["player_0"], "b": ["player_1"]}
    algorithm = build(qmix_league("discrete", {"agents": 2}, policies, policies_to_train=["b"]))
    try:
        learner = algorithm.learner_group._learner
        initial = {name: [p.detach().clone() for p in net.parameters()] for name, net in learner.networks.items()}
        algorithm.train()
        changed = {
            name: any(not torch.equal(a, b) for a, b in zip(initial[name], net.parameters(), strict=True))
            for name, net in learner.networks.items()
        }
    finally:
        algorithm.stop()
    assert changed == {"a": False, "b": True, "mixer/team": True}


@pytest.mark.parametrize("settings", [{}, MEMORY], ids=["feed-forward", "memory"])
def test_agents_are_trained_on_while_they_are_present(settings: dict[str, Any]) -> None:
    groups = {f"team_{i}": [f"agent_{i}"] for i in range(3)}
    document = qmix_league("discrete", groups=groups, **settings).model_dump(mode="json", by_alias=True)
    document["environment"]["entry_point"] = "tests.support.environments.simultaneous:meeting"
    document["environment"]["kwargs"] = {"arrives": [0, 2, 0], "leaves": [5, 6, 3], "truncated": [1]}
    document["policies"] = {f"policy_{i}": [f"agent_{i}"] for i in range(3)}
    league = LeagueConfig.from_mapping(document)

    def inspect_algorithm(algorithm: OffPolicy, result: dict[str, Any]) -> None:
        rows = algorithm.replays[JOINT].sample(500).rows
        assert 0 < rows[f"{PRESENT}/policy_1"].mean() < 1
        assert np.isfinite(result[LEARNER_RESULTS][JOINT]["loss"])

    train(league, 2, inspect_algorithm)


def test_the_mixer_uses_the_state_of_rllib_infos() -> None:
    config = LeagueConfig.load("policy_league/configs/two_step_game.yaml")
    document = config.model_dump(mode="json", by_alias=True)
    document["environment"] |= {"entry_point": "policy_league.examples.two_step:multi_agent_env", "wrappers": []}
    document["policies"] = {"first": ["agent_0"], "second": ["agent_1"]}
    league = LeagueConfig.from_mapping(document)

    def inspect_algorithm(algorithm: OffPolicy, _: dict[str, Any]) -> None:
        mixer = algorithm.learner_group._learner.networks["mixer/team"]
        assert isinstance(mixer, MonotonicMixer)
        assert mixer.first_weights.in_features == 3
        assert algorithm.replays[JOINT].sample(10).rows[STATE].shape == (10, 3)

    train(league, 1, inspect_algorithm)


def test_actions_without_values_are_rejected() -> None:
    league = qmix_league("numbers")
    with pytest.raises(ConfigError, match=r"training\.groups\.team: qmix needs Discrete actions, but player_0 has"):
        algorithm_config(league, interface(league))
