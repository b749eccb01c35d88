"""Training is the same with a vectorised environment as with its stock environment in lockstep: samples and weights."""

from typing import Any

import numpy as np
import pytest
import torch

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment
from league.environments.vector_stepping import VectorStepping
from training.algorithms.rllib_config import algorithm_config
from training.learners.ppo import PPOLearner
from training.rllib_compat import TrainingData
from training.sampling import env_runner
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.episode_chunks import EpisodeChunks

OPPONENT = {"ref": "script:random", "share": 0.5}
LEAGUES: dict[str, tuple[str, dict[str, Any]]] = {
    "opponents and openings": (
        "pettingzoo.classic.tictactoe_v3",
        {"opponents": [OPPONENT], "opening_plies": 2},
    ),
    "recurrent": ("pettingzoo.classic.connect_four_v3", {"recurrence": {"width": 4, "sequence": 3}}),
    "simultaneous": ("mpe2.simple_spread_v3", {}),
    "wrapped": ("mpe2.simple_tag_v3", {}),
}

WRAPPERS: dict[str, list[Any]] = {
    "wrapped": ["pad_observations_v0", "agent_indicator_v0", {"frame_stack_v1": {"stack_size": 2}}, "clip_reward_v0"]
}

pytestmark = pytest.mark.usefixtures("ray_session")


def in_lockstep(*args: Any, fast_seeds: bool, **options: Any) -> BatchedEnvironment:
    """`stepping`, without vectorised environments."""
    assert not fast_seeds
    return stock_stepping(*args, **options)


def trained(league: LeagueConfig) -> tuple[list[list[EpisodeChunks]], dict[str, Any]]:
    """Three samples with an update after each, and the final weights."""
    config = algorithm_config(league, interface(league))
    torch.manual_seed(0)
    runner = BatchedEnvRunner(config, worker_index=0)
    learner = PPOLearner(config=config, module_spec=config.rl_module_spec)
    learner.build()
    samples = []
    for _ in range(3):
        runner.module.set_state(learner.module.get_state())
        samples.append(runner.sample_chunks(num_timesteps=120))
        learner.update(training_data=TrainingData(episodes=samples[-1]), num_epochs=1, minibatch_size=32)
    assert isinstance(runner.env, VectorStepping) == (env_runner.stepping is not in_lockstep)
    runner.stop()
    return samples, learner.module.get_state()


def assert_equal(first: Any, second: Any) -> None:
    """Equality of nested dictionaries of arrays, with dtypes."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key, value in first.items():
            assert_equal(value, second[key])
    else:
        np.testing.assert_array_equal(first, second, strict=True)


@pytest.mark.parametrize("name", LEAGUES)
def test_samples_and_weights_do_not_depend_on_the_implementation(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    entry_point, training = LEAGUES[name]
    settings = {"runners": 0, "num_envs": 5, "hidden": [8], "train_batch_size": 120, "minibatch_size": 32}
    environment = {"entry_point": entry_point, "wrappers": WRAPPERS.get(name, [])}
    league = LeagueConfig.from_mapping({"league": "same", "environment": environment, "training": settings | training})
    vectorised = trained(league)
    monkeypatch.setattr(env_runner, "stepping", in_lockstep)
    stock = trained(league)
    for mine, theirs in zip(vectorised[0], stock[0], strict=True):
        assert [chunks.policy for chunks in mine] == [chunks.policy for chunks in theirs]
        for own, other in zip(mine, theirs, strict=True):
            for column in EpisodeChunks.__slots__:
                assert_equal(getattr(own, column), getattr(other, column))
    assert_equal(vectorised[1], stock[1])
