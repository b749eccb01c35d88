"""QMIX solves what a sum of values cannot represent. What it has in common with others: `test_off_policy.py`."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ray.rllib.utils.metrics import LEARNER_RESULTS

from benchmarks.training import two_step
from league.config.league import LeagueConfig
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import qmix_league
from tests.support.off_policy import build, train
from training.algorithms.off_policy import OffPolicy
from training.modules.policy_module import PREVIOUS_ACTION
from training.modules.qmix import MonotonicMixer
from training.sampling.closed_transitions import JOINT, PRESENT, STATE

pytestmark = pytest.mark.usefixtures("ray_session")
MEMORY = {"recurrence": {"width": 16, "sequence": 3}, "batch_size": 32, "hidden": [16]}


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
