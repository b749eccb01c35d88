"""Central critics and normalised values in the learner, on samples of a runner in this process."""

from typing import Any

import numpy as np
import pytest
import torch

from league.environments.building import interface
from tests.support.leagues.training_leagues import counting, solvable
from tests.support.learners import episodes_of, learner_of, update
from training.algorithms.rllib_config import module_spec
from training.learners.ppo import CRITICS, EXPLAINED_VARIANCE, SCALES, PPOLearner
from training.sampling.episode_chunks import EpisodeChunks

TWO: dict[str, Any] = {"policies": {"a": ["player_0"], "b": ["player_1"]}}


def explained(learner: PPOLearner, episodes: list[EpisodeChunks], updates: int = 1, **options: Any) -> dict[str, float]:
    """The explained variance of each policy's values before the last update."""
    for _ in range(updates):
        metrics = update(learner, episodes, **{"num_epochs": 6} | options)
    return {policy: row[EXPLAINED_VARIANCE] for policy, row in metrics.items()}


def copied(learner: PPOLearner) -> dict[str, torch.Tensor]:
    return {
        f"{policy} {name}": value.clone()
        for policy, critic in learner._critics.items()
        for name, value in critic.state_dict().items()
    }


@pytest.mark.parametrize(
    ("critic", "options"),
    [
        ("own", {}),
        ("state", {}),
        ("central", TWO),
        ("central", TWO | {"shared_encoder": True}),
        ("central", {"recurrence": {"width": 8, "sequence": 2}, "normalize_values": True}),
    ],
)
def test_only_a_central_critic_predicts_what_another_agent_sees(critic: str, options: dict[str, Any]) -> None:
    league = solvable("watching", **options, gamma=0.0, critic=critic)
    torch.manual_seed(3)
    shares = explained(learner_of(league), episodes_of(league), updates=5, minibatch_size=32)
    assert all(value < 0.2 if critic == "own" else value > 0.9 for value in shares.values())


def test_observation_spaces_may_differ_and_agents_may_leave() -> None:
    league = counting([3, 5, 1], [1], critic="central", normalize_values=True, normalize_observations=True)
    assert all(map(np.isfinite, explained(learner_of(league), episodes_of(league), updates=2).values()))


def test_modules_have_no_part_of_the_critic() -> None:
    """So that runners, graphs and servers are the same with any critic."""
    league = solvable("watching", critic="central")
    plain = module_spec(league.with_training(critic="own").training, interface(league)).build()["shared"]
    assert learner_of(league).module["shared"].get_state().keys() == plain.get_state().keys()


def test_the_critic_of_a_frozen_policy_keeps_its_weights() -> None:
    league = solvable("watching", **TWO, critic="central", normalize_values=True)
    learner, episodes = learner_of(league), episodes_of(league)
    before = copied(learner)
    update(learner, episodes, policies=("b",))
    changed = {name[0] for name, value in copied(learner).items() if not torch.equal(value, before[name])}
    assert changed == {"b"}
    assert {policy: float(scale.count) > 0 for policy, scale in learner._scales.items()} == {"a": False, "b": True}


def test_the_state_contains_critics_and_scales_and_may_lack_them() -> None:
    """A run with its own critic continues with a central one, which starts anew, and the other way round."""
    central = solvable("watching", critic="central", normalize_values=True)
    plain = solvable("watching")
    learner = learner_of(central)
    update(learner, episodes_of(central))
    state, initial = learner.get_state(), learner_of(plain).get_state()
    assert {CRITICS, SCALES} <= state.keys()
    assert not {CRITICS, SCALES} & initial.keys()
    restored = learner_of(central)
    restored.set_state(state)
    assert all(torch.equal(value, copied(learner)[name]) for name, value in copied(restored).items())
    assert float(restored._scales["shared"].mean) == float(learner._scales["shared"].mean) != 0
    before = copied(restored)
    restored.set_state(initial)
    assert all(torch.equal(value, before[name]) for name, value in copied(restored).items())
    learner_of(plain).set_state(state)
