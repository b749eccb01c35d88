"""Episodes with everything the protocol allows, as transitions, and joint transitions of simultaneous agents."""

from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.config.league import LeagueConfig
from league.config.opponents import OpponentConfig
from league.config.ppo import PPOConfig
from league.environments.building import interface as interface_of
from league.environments.implementation import stock_stepping
from league.errors import EnvironmentMismatch
from league.random.seeds import generator
from tests.support.environments.scripted_environment import AgentRecord, Scripted, interface
from tests.support.examples import examples
from tests.support.leagues.training_leagues import small, tictactoe
from tests.support.policies.self_play import FRAGMENT_LENGTHS, INITIAL, RANDOM, forward
from training.replay_buffer import NEXT, TransitionBlock
from training.sampling.closed_transitions import (
    ACTIONS,
    JOINT,
    OBSERVATIONS,
    PRESENT,
    REWARDS,
    STATE,
    TERMINATED,
    TRUNCATED,
    JointTransitions,
    PolicyTransitions,
    state_size,
)
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import SelfPlay

RUNNER = {"runner": 1, "runners": 2, "steps": 0}


def expected_rows(seed: int, agent: int, record: AgentRecord) -> list[tuple[object, ...]]:
    """(agent, seed, row), reward and flags of each closed transition, from the first row of the agent's policy."""
    following_rewards = [*record.rewards, *([record.ending.reward] if record.ending else [])]
    rows: list[tuple[object, ...]] = []
    for row, group in enumerate(record.groups):
        is_last = row == len(record.groups) - 1
        if record.is_own(group) and not (is_last and record.ending is None):
            ends = (record.ending.terminated, record.ending.truncated) if is_last and record.ending else (False, False)
            rows.append(((agent, seed, row), following_rewards[row + 1], *ends))
    return rows


@given(
    agents=st.integers(1, 4),
    num_envs=st.integers(1, 3),
    crashing=st.sampled_from([0.0, 0.2]),
    plies=st.sampled_from([0, 3]),
    opponents=st.sampled_from([[], [RANDOM]]),
    fragment_lengths=FRAGMENT_LENGTHS,
)
@examples(75)
def test_each_transition_is_recorded_once_with_its_successor(
    agents: int,
    num_envs: int,
    crashing: float,
    plies: int,
    opponents: list[OpponentConfig],
    fragment_lengths: list[int],
) -> None:
    env = Scripted(agents, num_envs, crashing)
    interface_of_league = interface(agents)
    config = PPOConfig.model_validate({"opponents": opponents if agents > 1 else []})
    recorder = PolicyTransitions(interface_of_league, env.agents, num_envs)
    play = SelfPlay(env, interface_of_league, config, recorder, INITIAL, opening_plies=plies)
    play.begin(ResetSeeds.of_run(3, num_envs=num_envs, **RUNNER), generator(3, "play"))
    recorded, streams = defaultdict(list), {}
    for steps in fragment_lengths:
        for _ in range(steps):
            play.step(forward, explore=True)
        for policy, block in recorder.cut().items():
            for i in range(len(block)):
                row = {name: column[i] for name, column in block.rows.items()}
                agent, seed, number = row[f"{OBSERVATIONS}/observation"].astype(int)
                assert policy == f"policy_{agent % 2}"
                assert row[f"{NEXT}{OBSERVATIONS}/observation"].tolist() == [agent, seed, number + 1]
                assert row[f"{OBSERVATIONS}/action_mask"][row[ACTIONS]]
                recorded[seed, agent].append(((agent, seed, number), row[REWARDS], row[TERMINATED], row[TRUNCATED]))
                # A row continues the latest row of its stream, which must be its predecessor, or starts an episode.
                assert block.firsts[i] or streams[policy, block.streams[i]] == (seed, agent, number - 1)
                streams[policy, block.streams[i]] = (seed, agent, number)
    for seed, played in env.played.items():
        for agent, record in played.agents.items():
            expected = expected_rows(seed, agent, record)
            rows = recorded.pop((seed, agent), [])
            assert rows == expected[: len(rows)] if played.is_lost else rows == expected
    assert not recorded


def joint(league: LeagueConfig, steps: int, num_envs: int = 2) -> TransitionBlock:
    interface_of_league = interface_of(league)
    env = stock_stepping(league.environment, num_envs, states=True)
    try:
        recorder = JointTransitions(interface_of_league, env.agents, num_envs)
        play = SelfPlay(
            env,
            interface_of_league,
            league.training,
            recorder,
            {policy: {} for policy in interface_of_league.policy_ids},
            opening_plies=league.training_openings,
        )
        play.begin(ResetSeeds.of_run(3, num_envs=num_envs, **RUNNER), generator(3, "play"))
        for _ in range(steps):
            play.step(None, explore=True)
        return recorder.cut()[JOINT]
    finally:
        env.close()


def leaving() -> LeagueConfig:
    """Agent i leaves after i + 2 steps, the second one truncated."""
    policies = {f"policy_{i}": [f"agent_{i}"] for i in range(2)}
    return small("tests.support.environments.simultaneous:meeting", {"leaves": [2, 3], "truncated": [1]}, policies)


def test_joint_rows_of_agents_that_leave_at_different_times() -> None:
    """Without an environment state, the state is the observations of all agents; those of absent agents are zeros."""
    block = joint(leaving(), steps=6)
    rows = {name: column[::2] for name, column in block.rows.items()}  # of the first of two environments
    assert rows[f"{PRESENT}/policy_0"][:, 0].tolist() == [True, True, False] * 2
    assert rows[f"{PRESENT}/policy_1"][:, 0].tolist() == [True, True, True] * 2
    assert rows[f"{TERMINATED}/policy_0"][:, 0].tolist() == [False, True, False] * 2
    assert rows[f"{TRUNCATED}/policy_1"][:, 0].tolist() == [False, False, True] * 2
    assert not rows[f"{TERMINATED}/policy_1"].any()
    assert rows[f"{REWARDS}/policy_0"][:, 0].tolist() == [1, 1, 0] * 2
    # The number of each agent and of its step.
    assert rows[STATE][:, [0, 1, 3, 4]].tolist() == [[0, 0, 1, 0], [0, 1, 1, 1], [0, 0, 1, 2]] * 2
    assert rows[NEXT + STATE][:, [0, 1, 3, 4]].tolist() == [[0, 1, 1, 1], [0, 2, 1, 2], [0, 0, 1, 3]] * 2
    assert not rows[STATE][[2, 5], :3].any()
    assert block.firsts[::2].tolist() == [True, False, False] * 2
    assert state_size(leaving().environment, interface_of(leaving())) == 6


def test_joint_rows_have_the_last_state_of_an_episode() -> None:
    """simple_spread: the state is all observations, and an episode is truncated after 25 steps."""
    league = small("mpe2.simple_spread_v3")
    block = joint(league, steps=30, num_envs=1)
    observations, next_observations = (block.rows[f"{head}{OBSERVATIONS}/shared/observation"] for head in ("", NEXT))
    np.testing.assert_array_equal(block.rows[STATE], observations.reshape(30, -1))
    np.testing.assert_array_equal(block.rows[NEXT + STATE], next_observations.reshape(30, -1))
    assert np.flatnonzero(block.firsts).tolist() == [0, 25]
    assert np.flatnonzero(block.rows[f"{TRUNCATED}/shared"].all(axis=1)).tolist() == [24]
    assert not np.array_equal(next_observations[24], observations[25]), "the last one of the episode"
    assert state_size(league.environment, interface_of(league)) == 54


def test_turn_based_agents_have_no_joint_transitions() -> None:
    with pytest.raises(EnvironmentMismatch, match="all agents act at once"):
        joint(tictactoe(), steps=3)
