from typing import Any

import numpy as np
import pytest
from pettingzoo.utils.wrappers import TerminateIllegalWrapper

from league.config.environment import EnvironmentConfig
from league.environments.building import build
from league.environments.lockstep import stock_stepping
from league.environments.stepping import BatchedEnvironment, Starts, Turn, each_agent_alone
from league.errors import IllegalAction
from tests.conformance.stepping import assert_abandoning_conforms, assert_stepping_conforms
from tests.support.environments.episodes import episodes

COUNTING = "tests.support.environments.counting:counting"


def counting(**kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=COUNTING, kwargs=kwargs)


ENVIRONMENTS = {
    "connect_four": EnvironmentConfig(entry_point="pettingzoo.classic.connect_four_v3"),
    "tictactoe": EnvironmentConfig(entry_point="pettingzoo.classic.tictactoe_v3"),
    "all terminate": counting(lives=[3, 3]),
    "all truncated": counting(lives=[3, 3], truncated=[0, 1]),
    "mixed, with early deaths": counting(lives=[1, 4, 2, 4], truncated=[1, 2]),
}


@pytest.mark.parametrize("num_envs", [1, 3, 8])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_lockstep_equals_the_plain_loop(name: str, num_envs: int) -> None:
    config = ENVIRONMENTS[name]
    assert_stepping_conforms(
        lambda n: stock_stepping(config, n), lambda: build(config), seeds=list(range(100, 112)), num_envs=num_envs
    )


@pytest.mark.parametrize("num_envs", [1, 3, 8])
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_abandoned_episode_has_no_effect_on_the_next(name: str, num_envs: int) -> None:
    config = ENVIRONMENTS[name]
    assert_abandoning_conforms(
        lambda n: stock_stepping(config, n), lambda: build(config), seeds=list(range(100, 112)), num_envs=num_envs
    )


def play_out(env: BatchedEnvironment, turn: Turn) -> list[Turn]:
    turns = [turn]
    while turn.batches:
        turn = env.step({group: np.zeros(len(batch), int) for group, batch in turn.batches.items()})
        turns.append(turn)
    return turns


def test_truncated_agents_are_not_terminated_and_keep_their_last_observation() -> None:
    env = stock_stepping(counting(lives=[2, 3], truncated=[1]), num_envs=1)
    turns = play_out(env, env.start(each_agent_alone([5], 2)))
    endings = [ending for turn in turns for ending in turn.each_ending()]
    flags = {ending.agent: (ending.terminated, ending.truncated) for ending in endings}
    assert flags == {0: (True, False), 1: (False, True)}
    last = {ending.agent: ending.observation["observation"].tolist() for ending in endings}
    assert last == {0: [0, 2, 5], 1: [1, 3, 5]}


def test_rewards_between_turns_are_summed() -> None:
    env = stock_stepping(counting(lives=[3, 3]), num_envs=1)
    turns = play_out(env, env.start(each_agent_alone([0], 2)))
    rewards = [(group, batch.rewards[0]) for turn in turns for group, batch in turn.batches.items()]
    assert rewards == [(0, 0.0), (1, 10.0), (0, 2.0), (1, 20.0), (0, 2.0), (1, 20.0)]
    assert [(ending.agent, ending.reward) for turn in turns for ending in turn.each_ending()] == [(0, 1.0), (1, 10.0)]


def test_each_episode_is_reset_with_its_seed() -> None:
    env = stock_stepping(counting(lives=[1, 1]), num_envs=2)
    seeds = iter(range(10, 16))
    seeds_by_env: dict[int, list[int]] = {0: [], 1: []}

    def next_episodes(envs: np.ndarray) -> Starts:
        taken = list(zip(envs.tolist(), seeds, strict=False))
        for env_index, seed in taken:
            seeds_by_env[env_index].append(seed)
        return Starts(envs[: len(taken)], np.array([seed for _, seed in taken]), np.tile([0, 1], (len(taken), 1)))

    turns = play_out(env, env.start(next_episodes))
    for env_index in (0, 1):
        reset_seeds = [
            int(ending.observation["observation"][2])
            for turn in turns
            for ending in turn.each_ending()
            if ending.env == env_index and ending.agent == 0
        ]
        assert reset_seeds == seeds_by_env[env_index]


def test_groups_can_change_within_an_episode() -> None:
    env = stock_stepping(counting(lives=[2, 2]), num_envs=1)
    turn = env.start(episodes([0], [7, 7]))
    assert list(turn.batches) == [7]
    env.assign(np.array([0]), np.array([[1, 2]]))
    turn = env.step({7: np.array([0])})
    assert list(turn.batches) == [2]


def test_agents_of_a_group_share_a_batch() -> None:
    env = stock_stepping(ENVIRONMENTS["connect_four"], num_envs=5)
    turn = env.start(episodes(range(5), [3, 3]))
    batch = turn.batches[3]
    assert batch.envs.tolist() == [0, 1, 2, 3, 4]
    assert batch.observations["observation"].shape == (5, 6, 7, 2)
    assert batch.observations["action_mask"].dtype == np.int8


@pytest.mark.parametrize("action", [9, -1])
def test_an_illegal_action_is_rejected_before_any_step(action: int) -> None:
    env = stock_stepping(ENVIRONMENTS["tictactoe"], num_envs=2)
    turn = env.start(each_agent_alone([0, 0], 2))
    with pytest.raises(IllegalAction, match=rf"action {action} of player_1 is illegal"):
        env.step({0: np.array([0, action])})
    turn = env.step({0: np.array([4, 4])})
    assert (turn.batches[1].observations["observation"].sum(axis=(1, 2, 3)) == 1).all()
    with pytest.raises(IllegalAction, match="action_mask is"):
        env.step({1: np.array([4, 0])})


def test_checking_wrappers_are_removed_and_others_kept() -> None:
    assert not isinstance(build(ENVIRONMENTS["connect_four"]), TerminateIllegalWrapper)
    wrapped = EnvironmentConfig.model_validate(
        {"entry_point": COUNTING, "wrappers": [{"frame_stack_v1": {"stack_size": 2}}]}
    )
    env = stock_stepping(wrapped, num_envs=1)
    assert env.start(each_agent_alone([0], 2)).batches[0].observations["observation"].shape == (1, 6)
