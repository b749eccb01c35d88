"""All that the protocol allows, recorded as closed transitions; joint ones of environments in which all act at once."""

from collections import defaultdict
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pettingzoo import ParallelEnv

from league.config import LeagueConfig
from league.environments.building import interface as interface_of
from league.environments.lockstep import stepping
from league.errors import EnvironmentMismatch
from league.seeds import generator
from league.training_config import OpponentConfig, PPOConfig
from tests.training.leagues import tictactoe
from tests.training.sampling.scripted import Scripted, Seen, interface
from tests.training.sampling.test_self_play import CUTS, INITIAL, RANDOM, think
from training.replay import NEXT, Block
from training.sampling.closed import (
    ACTIONS,
    JOINT,
    OBSERVATIONS,
    PRESENT,
    REWARDS,
    STATE,
    TERMINATED,
    TRUNCATED,
    JointTransitions,
    OwnTransitions,
    state_size,
)
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import SelfPlay

RUNNER = {"runner": 1, "runners": 2, "steps": 0}


def expected_rows(seed: int, agent: int, seen: Seen) -> list[tuple[object, ...]]:
    """(agent, seed, row), reward, flags of each transition that was closed, from where the agent's policy took over."""
    later = [*seen.rewards, *([seen.ending.reward] if seen.ending else [])]
    rows: list[tuple[object, ...]] = []
    for row, group in enumerate(seen.groups):
        is_last = row == len(seen.groups) - 1
        if isinstance(group, str) and not (is_last and seen.ending is None):
            ends = (seen.ending.terminated, seen.ending.truncated) if is_last and seen.ending else (False, False)
            rows.append(((agent, seed, row), later[row + 1], *ends))
    return rows


@given(
    agents=st.integers(1, 4),
    copies=st.integers(1, 3),
    crashing=st.sampled_from([0.0, 0.2]),
    plies=st.sampled_from([0, 3]),
    opponents=st.sampled_from([[], [RANDOM]]),
    cuts=CUTS,
)
@settings(deadline=None, max_examples=100, suppress_health_check=[HealthCheck.too_slow])
def test_every_transition_of_a_policy_is_there_once_with_its_successor(
    agents: int, copies: int, crashing: float, plies: int, opponents: list[OpponentConfig], cuts: list[int]
) -> None:
    env = Scripted(agents, copies, crashing)
    described = interface(agents)
    config = PPOConfig.model_validate({"opening_plies": plies, "opponents": opponents if agents > 1 else []})
    recorder = OwnTransitions(described, env.agents, copies)
    play = SelfPlay(env, described, config, recorder, INITIAL)
    play.begin(ResetSeeds.of_run(3, copies=copies, **RUNNER), generator(3, "play"))
    found, streams = defaultdict(list), {}
    for steps in cuts:
        for _ in range(steps):
            play.step(think, explore=True)
        for policy, block in recorder.cut().items():
            for i in range(len(block)):
                row = {name: column[i] for name, column in block.rows.items()}
                agent, seed, number = row[f"{OBSERVATIONS}/observation"].astype(int)
                assert policy == f"policy_{agent % 2}"
                assert row[f"{NEXT}{OBSERVATIONS}/observation"].tolist() == [agent, seed, number + 1]
                assert row[f"{OBSERVATIONS}/action_mask"][row[ACTIONS]]
                found[seed, agent].append(((agent, seed, number), row[REWARDS], row[TERMINATED], row[TRUNCATED]))
                # A row goes on from the newest of its stream, which must be the row before, or begins anew.
                assert block.firsts[i] or streams[policy, block.streams[i]] == (seed, agent, number - 1)
                streams[policy, block.streams[i]] = (seed, agent, number)
    for seed, played in env.played.items():
        for agent, seen in played.agents.items():
            expected = expected_rows(seed, agent, seen)
            own = found.pop((seed, agent), [])
            assert own == expected[: len(own)] if played.is_lost else own == expected
    assert not found


def joint(league: LeagueConfig, steps: int, copies: int = 2) -> Block:
    described = interface_of(league)
    env = stepping(league.environment, copies, states=True)
    try:
        recorder = JointTransitions(described, env.agents, copies)
        play = SelfPlay(env, described, league.training, recorder, {policy: {} for policy in described.policy_ids})
        play.begin(ResetSeeds.of_run(3, copies=copies, **RUNNER), generator(3, "play"))
        for _ in range(steps):
            play.step(None, explore=True)
        return recorder.cut()[JOINT]
    finally:
        env.close()


class Leaving(ParallelEnv):
    """Agent i leaves after i + 2 steps, the second one truncated; it observes how many there were."""

    possible_agents = ("player_0", "player_1")

    def observation_space(self, agent: str) -> gymnasium.Space:
        return gymnasium.spaces.Box(0, 9, (1 + self.possible_agents.index(agent),), np.float32)

    def action_space(self, agent: str) -> gymnasium.Space:
        return gymnasium.spaces.Discrete(2)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self._steps = list(self.possible_agents), 0
        return self._seen(), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, int]) -> Any:
        self._steps += 1
        terminated = {agent: agent == "player_0" and self._steps == 2 for agent in self.agents}
        truncated = {agent: agent == "player_1" and self._steps == 3 for agent in self.agents}
        seen, rewards = self._seen(), dict.fromkeys(self.agents, float(self._steps))
        self.agents = [agent for agent in self.agents if not (terminated[agent] or truncated[agent])]
        return seen, rewards, terminated, truncated, {agent: {} for agent in seen}

    def _seen(self) -> dict[str, Any]:
        spaces = {agent: self.observation_space(agent) for agent in self.agents}
        return {agent: np.full(space.shape, self._steps, np.float32) for agent, space in spaces.items()}


def leaving() -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "leaving",
            "environment": {"entry_point": f"{__name__}:Leaving"},
            "policies": {"policy_0": ["player_0"], "policy_1": ["player_1"]},
        }
    )


def test_joint_rows_of_agents_that_leave_at_different_times() -> None:
    """Without a state of its own, the environment's is what all agents observe; who is gone observes zeros."""
    block = joint(leaving(), steps=6)
    rows = {name: column[::2] for name, column in block.rows.items()}  # of the first copy of two
    assert rows[f"{PRESENT}/policy_0"][:, 0].tolist() == [True, True, False] * 2
    assert rows[f"{PRESENT}/policy_1"][:, 0].tolist() == [True, True, True] * 2
    assert rows[f"{TERMINATED}/policy_0"][:, 0].tolist() == [False, True, False] * 2
    assert rows[f"{TRUNCATED}/policy_1"][:, 0].tolist() == [False, False, True] * 2
    assert not rows[f"{TERMINATED}/policy_1"].any()
    assert rows[f"{REWARDS}/policy_0"][:, 0].tolist() == [1, 2, 0] * 2
    assert rows[STATE].tolist() == [[0, 0, 0], [1, 1, 1], [0, 2, 2]] * 2
    assert rows[NEXT + STATE].tolist() == [[1, 1, 1], [2, 2, 2], [0, 3, 3]] * 2
    assert block.firsts[::2].tolist() == [True, False, False] * 2
    assert state_size(leaving().environment, interface_of(leaving())) == 3


def test_joint_rows_have_the_state_that_an_episode_ended_in() -> None:
    """simple_spread: the state is all observations, and an episode is truncated after 25 steps."""
    league = LeagueConfig.from_mapping({"league": "spread", "environment": {"entry_point": "mpe2.simple_spread_v3"}})
    block = joint(league, steps=30, copies=1)
    seen, after = (block.rows[f"{head}{OBSERVATIONS}/shared/observation"] for head in ("", NEXT))
    np.testing.assert_array_equal(block.rows[STATE], seen.reshape(30, -1))
    np.testing.assert_array_equal(block.rows[NEXT + STATE], after.reshape(30, -1))
    assert np.flatnonzero(block.firsts).tolist() == [0, 25]
    assert np.flatnonzero(block.rows[f"{TRUNCATED}/shared"].all(axis=1)).tolist() == [24]
    assert not np.array_equal(after[24], seen[25]), "the last observation, not the next episode's first"
    assert state_size(league.environment, interface_of(league)) == 54


def test_agents_that_take_turns_have_no_joint_transitions() -> None:
    with pytest.raises(EnvironmentMismatch, match="all agents act at once"):
        joint(tictactoe(), steps=3)
