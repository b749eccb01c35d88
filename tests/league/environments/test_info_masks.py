"""Masks in infos become part of the observations, for both APIs of PettingZoo."""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.classic import tictactoe_v3

from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import action_space, build, interface
from league.environments.conformance.examination import examine
from league.environments.lockstep import stock_stepping
from league.errors import EnvironmentMismatch
from league.spaces import ACTION_MASK, OBSERVATION, DictSpace
from tests.conformance.stepping import assert_same_episode, lockstep


class InfoMaskTicTacToe(tictactoe_v3.raw_env):
    """Tic-tac-toe that reports its masks in infos only."""

    def observation_space(self, agent: str) -> spaces.Space:
        return super().observation_space(agent)["observation"]

    def observe(self, agent: str) -> Any:
        observation = super().observe(agent)
        self.infos[agent] = {"action_mask": observation["action_mask"]}
        return observation["observation"]

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        super().reset(seed, options)
        for agent in self.agents:
            self.observe(agent)

    def step(self, action: int | None) -> None:
        if action is not None and not self.infos[self.agent_selection]["action_mask"][action]:
            raise ValueError(f"illegal action {action}")
        super().step(action)
        for agent in self.agents:
            self.observe(agent)


class Countdown(ParallelEnv):
    """Two agents with two actions each; the second action is legal in odd steps only."""

    metadata: dict[str, Any] = {"name": "countdown"}  # noqa: RUF012
    possible_agents = ["left", "right"]  # noqa: RUF012

    def __init__(self, width: int = 2, without: str | None = None) -> None:
        self._width, self._without = width, without

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 10, (1,), np.float32)

    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Discrete(2)

    def _report(self) -> tuple[dict, dict]:
        mask = np.array([1] + [self._left % 2] * (self._width - 1), np.int8)
        observations = {agent: np.array([self._left], np.float32) for agent in self.agents}
        return observations, {agent: {"action_mask": mask} for agent in self.agents if agent != self._without}

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.agents, self._left = list(self.possible_agents), 5
        return self._report()

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        for agent, action in actions.items():
            if action == 1 and self._left % 2 == 0 and agent != self._without:
                raise ValueError("illegal action 1")
        self._left -= 1
        observations, infos = self._report()
        ended = dict.fromkeys(self.agents, self._left == 0)
        rewards = {agent: float(actions[agent]) for agent in self.agents}
        if self._left == 0:
            self.agents = []
        return observations, rewards, ended, dict.fromkeys(ended, False), infos


def tictactoe() -> AECEnv:
    return InfoMaskTicTacToe()


def countdown(**kwargs: Any) -> ParallelEnv:
    return Countdown(**kwargs)


def league(entry_point: str, **kwargs: Any) -> LeagueConfig:
    environment = {"entry_point": f"{__name__}:{entry_point}", "kwargs": kwargs}
    return LeagueConfig.from_mapping({"league": "masks", "environment": environment})


@pytest.mark.parametrize("entry_point", ["tictactoe", "countdown"])
def test_masks_are_part_of_the_observations(entry_point: str) -> None:
    for spaces_of_agent in interface(league(entry_point)).agents.values():
        assert isinstance(spaces_of_agent.observation, DictSpace)
        assert set(spaces_of_agent.observation.spaces) == {OBSERVATION, ACTION_MASK}


@pytest.mark.parametrize("entry_point", ["tictactoe", "countdown"])
def test_random_legal_actions_follow_the_masks(entry_point: str) -> None:
    found = examine(league(entry_point), episodes=10)
    assert found.passed, found.findings


def test_episodes_equal_those_of_masks_in_observations() -> None:
    ours = league("tictactoe").environment
    stock = EnvironmentConfig(entry_point="pettingzoo.classic.tictactoe_v3")
    spaces = {agent: action_space(build(stock), agent) for agent in ("player_1", "player_2")}
    seeds = list(range(8))
    expected = lockstep(stock_stepping(stock, 4), spaces, seeds)
    for seed, episode in lockstep(stock_stepping(ours, 4), spaces, seeds).items():
        assert_same_episode(episode, expected[seed])


def test_an_agent_without_a_mask_may_take_all_actions() -> None:
    env = build(league("countdown", without="right").environment)
    observations, _ = env.reset(seed=1)
    assert observations["right"][ACTION_MASK].tolist() == [1, 1]
    observations, *_ = env.step({"left": 0, "right": 1})
    assert observations["left"][ACTION_MASK].tolist() == [1, 0]


def test_a_mask_of_another_width_is_rejected() -> None:
    env = build(league("countdown", width=3).environment)
    with pytest.raises(EnvironmentMismatch, match=r"agent 'left' has an action_mask of shape \[3\], expected \[2\]"):
        env.reset(seed=1)


def test_an_environment_without_masks_is_returned_as_it_is() -> None:
    config = LeagueConfig.from_mapping({"league": "x", "environment": {"entry_point": "pettingzoo.classic.rps_v2"}})
    assert not isinstance(interface(config).agents["player_0"].observation, DictSpace)
