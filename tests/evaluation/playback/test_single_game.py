from typing import Any

import numpy as np
import pytest

from evaluation.playback.single_game import first_observation, play_game
from league.config.league import LeagueConfig
from league.environments.building import build, interface
from league.environments.lockstep import stock_stepping
from league.errors import UnknownPolicy
from league.policies.loading import contestant

ROLES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


def league(entry_point: str, **parts: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping({"league": "shown", "environment": {"entry_point": entry_point}} | parts)


@pytest.mark.parametrize(
    ("entry_point", "simultaneous"), [("pettingzoo.classic.tictactoe_v3", False), ("mpe2.simple_spread_v3", True)]
)
def test_a_game_is_played_step_by_step(entry_point: str, simultaneous: bool) -> None:
    config = league(entry_point)
    league_interface = interface(config)
    players = {agent: policy for agent, (_, policy) in contestant("script:random", None, league_interface).items()}
    steps = list(play_game(stock_stepping(config.environment, 1), players, seed=3))
    assert [step.step for step in steps] == list(range(len(steps)))
    assert [step.is_over for step in steps] == [False] * (len(steps) - 1) + [True]
    assert steps[0].moves == ()
    assert {len(step.moves) for step in steps[1:]} == {len(league_interface.agents) if simultaneous else 1}
    assert sorted(ending.agent for ending in steps[-1].endings) == list(range(len(league_interface.agents)))
    again = list(play_game(stock_stepping(config.environment, 1), players, seed=3))
    other = list(play_game(stock_stepping(config.environment, 1), players, seed=4))
    taken = [[[move.action for move in step.moves] for step in each] for each in (steps, again, other)]
    assert taken[0] == taken[1] != taken[2]
    assert steps[-1].returns == again[-1].returns


@pytest.mark.parametrize("entry_point", ["pettingzoo.classic.tictactoe_v3", "pettingzoo.classic.leduc_holdem_v4"])
def test_the_first_observation_equals_that_of_the_environment(entry_point: str) -> None:
    config = league(entry_point)
    env = build(config.environment)
    env.reset(seed=5)
    expected = env.observe(env.agent_selection)
    observation = first_observation(config, interface(config), None, seed=5)
    assert set(observation) == set(expected) == {"observation", "action_mask"}
    for key, value in expected.items():
        assert np.array_equal(np.array(observation[key], value.dtype), value)


def test_each_policy_of_simultaneous_agents_has_a_first_observation() -> None:
    config = league("mpe2.simple_adversary_v3", policies=ROLES)
    env = build(config.environment)
    expected, _ = env.reset(seed=5)
    for policy, agent in (("adversary", "adversary_0"), ("good", "agent_0")):
        observation = first_observation(config, interface(config), policy, seed=5)
        assert np.array_equal(np.array(observation, np.float32), expected[agent])


def test_a_policy_that_does_not_act_first_has_no_first_observation() -> None:
    config = league("pettingzoo.classic.tictactoe_v3", policies={"first": ["player_1"], "second": ["player_2"]})
    with pytest.raises(UnknownPolicy, match=r"'second' does not act first in shown \('first' does\)"):
        first_observation(config, interface(config), "second")
