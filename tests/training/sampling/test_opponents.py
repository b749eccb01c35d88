"""The memory of recurrent opponents."""

import numpy as np

from league.config.opponents import OpponentConfig
from league.environments.stepping import Batch
from tests.support.leagues.registries import interface
from tests.support.policies.bots import MODULE
from training.sampling.opponents import OpponentPolicy, Opponents
from training.sampling.recurrent_state import RecurrentStates


def test_opponents_forget_what_happened_in_earlier_episodes() -> None:
    opponents = Opponents([], interface(), None, num_envs=3)
    states = RecurrentStates({"h": np.zeros(2, np.float32)}, num_envs=3, agents=2)
    opponents._recurrent_states[OpponentPolicy("board@1", "shared")] = states
    envs = np.arange(3)
    batch = Batch(envs, np.zeros(3, np.int64), {}, np.zeros(3))
    states.update(batch, {"h": np.ones((3, 2), np.float32)})
    opponents.forget(np.array([0, 2]))
    np.testing.assert_array_equal(states.get(batch)["h"], [[0, 0], [1, 1], [0, 0]])


def test_bots_have_one_instance_for_each_agent_and_episode() -> None:
    ref = f"script:{MODULE}:Alternating"
    opponents = Opponents([OpponentConfig(ref=ref, share=1.0)], interface(), None, num_envs=2)
    observations = {"observation": np.zeros((2, 3, 3, 2), np.int8), "action_mask": np.ones((2, 9), np.int8)}
    batch = Batch(np.arange(2), np.zeros(2, np.int64), observations, np.zeros(2))

    def act() -> list[int]:
        return opponents.act(OpponentPolicy(ref, "shared"), batch, np.random.default_rng(0)).tolist()

    assert act() == [8, 8]
    opponents.forget(np.array([0]))
    assert act() == [8, 0]
