"""QMIX in this process: it finds what a sum of values cannot say, remembers, and goes on exactly where it was."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN, LEARNER_RESULTS

from benchmarks import two_step
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.training.environments import ROUNDS
from tests.training.leagues import by_values
from training import parity
from training.algorithms.dispatch import algorithm_config, module_spec
from training.algorithms.off_policy import OffPolicy
from training.export import export_policy, graph_tensors, state_names
from training.learners import qmix as learning
from training.learners.q_targets import next_actions
from training.modules.acting import ACTED, MASKED
from training.modules.mixer import MonotonicMixer
from training.sampling.closed import JOINT, PRESENT, STATE, TERMINATED, TRUNCATED, JointTransitions

pytestmark = pytest.mark.usefixtures("ray_session")
MEMORY = {"recurrence": {"width": 16, "sequence": 3}, "batch_size": 32, "hidden": [16]}
Look = Callable[[OffPolicy, dict[str, Any]], Any]


def mixed(name: str, kwargs: dict[str, Any] | None = None, policies: Any = None, **training: Any) -> LeagueConfig:
    """One of `tests.training.environments`, all agents on one team."""
    settings = {"algorithm": "qmix", "groups": {"team": ["*"]}, "mixing_width": 8}
    return by_values(name, kwargs, policies, **(settings | training))


def built(league: LeagueConfig) -> OffPolicy:
    algorithm = algorithm_config(league, interface(league)).build_algo()
    algorithm.begin_anew(0)
    return algorithm


def trained(league: LeagueConfig, updates: int, look: Look) -> Any:
    algorithm = built(league)
    try:
        for _ in range(updates):
            result = algorithm.train()
        return look(algorithm, result)
    finally:
        algorithm.stop()


def returns(_: OffPolicy, result: dict[str, Any]) -> dict[str, float]:
    return result[ENV_RUNNER_RESULTS][EPISODE_MODULE_RETURN_MEAN]


def test_the_two_step_game_is_solved_exactly() -> None:
    """`benchmarks.learning two_step_game`, one seed."""
    learned = two_step.learn("qmix", seed=0)
    assert learned.returned == 8
    assert learned.error(gamma=0.99) < 0.1


@pytest.mark.parametrize("mixer", ["vdn", "none"])
def test_what_cannot_say_it_takes_the_safe_game(mixer: str) -> None:
    """The negative controls: with sums, and alone, both agents forgo the game that could bring 8."""
    learned = two_step.learn(mixer, seed=0, steps=12_000)
    assert learned.returned == 7
    assert learned.error(gamma=0.99) > 1


@pytest.mark.parametrize("mixer", ["qmix", "vdn", "none"])
def test_agents_of_one_team_with_networks_of_their_own_learn(mixer: str) -> None:
    policies = {"a": ["player_0"], "b": ["player_1"]}
    found = trained(mixed("discrete", {"agents": 2}, policies, mixer=mixer), 14, returns)
    assert min(found.values()) > 0.85 * ROUNDS


def test_teams_that_compete_learn_each_its_own() -> None:
    groups = {"one": ["player_0"], "other": ["player_1", "player_2"]}
    league = mixed("discrete", {"agents": 3, "opposed": True}, {"a": ["player_0"], "b": ["*"]}, groups=groups)
    found = trained(league, 14, returns)
    assert found["a"] > 0.85 * ROUNDS
    assert found["b"] > -0.15 * ROUNDS


def test_a_memory_learns_what_is_to_be_remembered_and_no_memory_cannot() -> None:
    settings = {"gamma": 0.99, "copies": 8, "exploration": {"steps": 8000}}
    assert trained(mixed("remembering", **settings, **MEMORY), 14, returns)["shared"] > 0.8
    assert trained(mixed("remembering", **settings), 14, returns)["shared"] < 0.5


def test_the_memory_holds_the_actions_that_were_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """While exploring they are not the greedy ones."""
    algorithm = built(mixed("discrete", exploration={"initial": 1.0, "final": 1.0}, copies=4, **MEMORY))
    play = algorithm.env_runner_group.local_env_runner._play
    drawn, remembered = [], []
    act = play.recorder.act

    def watch(policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Any) -> None:
        drawn.append(raw.tolist())
        remembered.append(state[ACTED].ravel().tolist())
        act(policy, raw, log_p, dist_inputs, state)

    try:
        monkeypatch.setattr(play.recorder, "act", watch)
        algorithm.train()
    finally:
        algorithm.stop()
    assert len({tuple(row) for row in drawn}) > 10
    for step, rows in enumerate(remembered):
        assert rows == ([0.0] * 4 if step % ROUNDS == 0 else [action + 1.0 for action in drawn[step - 1]])


def check_values(gamma: float = 0.9, **settings: Any) -> None:
    """An agent that is truncated could have gone on: the state is worth what it is worth for ever, and an illegal
    action that seems to be worth a million counts for nothing."""
    league = mixed("masked", gamma=gamma, exploration={"initial": 0.5, "final": 0.5}, mixer="vdn", **settings)

    def look(algorithm: OffPolicy, _: Any) -> NDArray:
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

    found = trained(league, 1, look)
    assert found[1] == MASKED
    np.testing.assert_allclose(found[[0, 2]], 1 / (1 - gamma), rtol=0.1)


@pytest.mark.parametrize("settings", [{}, {"n_step": 3}, {"double": False}, {"gamma": 0.5} | MEMORY], ids=str)
def test_values_are_those_of_legal_play_that_goes_on(settings: dict[str, Any]) -> None:
    check_values(**settings)


def test_the_check_sees_truncation_taken_for_termination(monkeypatch: pytest.MonkeyPatch) -> None:
    cut = JointTransitions.cut

    def as_terminated(self: JointTransitions) -> Any:
        blocks = cut(self)
        for block in blocks.values():
            block.rows[f"{TERMINATED}/shared"] = block.rows[f"{TERMINATED}/shared"] | block.rows[f"{TRUNCATED}/shared"]
        return blocks

    monkeypatch.setattr(JointTransitions, "cut", as_terminated)
    with pytest.raises(AssertionError):
        check_values()


def test_the_check_sees_targets_without_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "next_actions", lambda online, target, _: next_actions(online, target, None))
    with pytest.raises(AssertionError):
        check_values()


@pytest.mark.parametrize("settings", [{"normalize_observations": True}, MEMORY], ids=["normalised", "memory"])
def test_what_begins_anew_at_the_same_step_goes_on_alike(settings: dict[str, Any], tmp_path: Path) -> None:
    """One that went on from its checkpoint, and one that was restored from it: agents, mixers, targets, the buffer."""
    league = mixed("discrete", {"agents": 2}, replay_capacity=700, **settings)

    def after(algorithm: OffPolicy) -> list[NDArray]:
        algorithm.begin_anew(2048)
        for _ in range(2):
            algorithm.train()
        learner = algorithm.learner_group._learner
        networks = [*learner.networks.values(), *learner.targets.values()]
        assert len(networks) == 4
        kept = algorithm.replays[JOINT].sample(64).rows.values()
        return [tensor.numpy().copy() for each in networks for tensor in each.state_dict().values()] + list(kept)

    def save(algorithm: OffPolicy, _: Any) -> list[NDArray]:
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        return after(algorithm)

    expected = trained(league, 2, save)
    torch.manual_seed(77)
    restored = built(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        found = after(restored)
    finally:
        restored.stop()
    for before, now in zip(expected, found, strict=True):
        np.testing.assert_array_equal(before, now)


@pytest.mark.parametrize("settings", [{}, MEMORY], ids=["feed-forward", "memory"])
def test_what_is_exported_sees_its_own_observation_alone(settings: dict[str, Any], tmp_path: Path) -> None:
    league = mixed("masked", **settings)
    described = interface(league)
    spaces = described.of_policy("shared")
    modules = module_spec(league.training, described).build()
    assert set(modules.keys()) == {"shared"}, "no mixer is played"
    module = modules["shared"]
    taken, _, state = graph_tensors(module, spaces)
    assert {tensor.name for tensor in taken} - {tensor.name for tensor in state} == {"observation", "action_mask"}
    export_policy(module, spaces, tmp_path / "shared.onnx")
    met = parity.gather(league.environment, described, {"shared": module}, seed=1)["shared"]
    proof = parity.prove(tmp_path / "shared.onnx", "shared", module, met, spaces.action)
    assert (proof.mismatches, proof.max_difference < 1e-5) == (0, True)
    recurrent = dict(zip(state_names(met[0].state), met[0].state.values(), strict=True))
    graph = OnnxPolicy(tmp_path / "shared.onnx").distribution(met[0].observations, state=recurrent or None)
    assert (graph.actions != 1).all()


def test_policies_that_rest_stay_as_they_are() -> None:
    policies = {"a": ["player_0"], "b": ["player_1"]}
    algorithm = built(mixed("discrete", {"agents": 2}, policies, policies_to_train=["b"]))
    try:
        learner = algorithm.learner_group._learner
        before = {name: [p.detach().clone() for p in net.parameters()] for name, net in learner.networks.items()}
        algorithm.train()
        changed = {
            name: any(not torch.equal(a, b) for a, b in zip(before[name], net.parameters(), strict=True))
            for name, net in learner.networks.items()
        }
    finally:
        algorithm.stop()
    assert changed == {"a": False, "b": True, "mixer/team": True}


@pytest.mark.parametrize("settings", [{}, MEMORY], ids=["feed-forward", "memory"])
def test_agents_that_come_and_go_are_learned_from_while_they_are_there(settings: dict[str, Any]) -> None:
    groups = {f"team_{i}": [f"agent_{i}"] for i in range(3)}
    document = mixed("discrete", groups=groups, **settings).model_dump(mode="json", by_alias=True)
    document["environment"]["entry_point"] = "tests.league.environments.simultaneous:meeting"
    document["environment"]["kwargs"] = {"arrives": [0, 2, 0], "leaves": [5, 6, 3], "truncated": [1]}
    document["policies"] = {f"policy_{i}": [f"agent_{i}"] for i in range(3)}
    league = LeagueConfig.from_mapping(document)

    def look(algorithm: OffPolicy, result: dict[str, Any]) -> None:
        rows = algorithm.replays[JOINT].sample(500).rows
        assert 0 < rows[f"{PRESENT}/policy_1"].mean() < 1
        assert np.isfinite(result[LEARNER_RESULTS][JOINT]["loss"])

    trained(league, 2, look)


def test_the_mixer_reads_the_state_that_rllibs_infos_tell() -> None:
    config = LeagueConfig.load("configs/two_step_game.yaml")
    document = config.model_dump(mode="json", by_alias=True)
    document["environment"] |= {"entry_point": "examples.two_step:multi_agent_env", "wrappers": []}
    document["policies"] = {"first": ["agent_0"], "second": ["agent_1"]}
    league = LeagueConfig.from_mapping(document)

    def look(algorithm: OffPolicy, _: dict[str, Any]) -> None:
        mixer = algorithm.learner_group._learner.networks["mixer/team"]
        assert isinstance(mixer, MonotonicMixer)
        assert mixer.first_weights.in_features == 3
        assert algorithm.replays[JOINT].sample(10).rows[STATE].shape == (10, 3)

    trained(league, 1, look)


def test_actions_that_have_no_values_are_refused_with_what_to_do() -> None:
    league = mixed("numbers")
    with pytest.raises(ConfigError, match=r"training\.groups\.team: qmix needs Discrete actions, and player_0 has"):
        algorithm_config(league, interface(league))
