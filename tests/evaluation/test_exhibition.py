from typing import Any

import numpy as np
import pytest

from evaluation.exhibition import exhibit, first_observation
from league.config import LeagueConfig
from league.environments.building import build, interface
from league.environments.lockstep import stepping
from league.errors import UnknownPolicy
from league.policies.loading import contestant

ROLES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


def league(entry_point: str, **parts: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping({"league": "shown", "environment": {"entry_point": entry_point}} | parts)


@pytest.mark.parametrize(
    ("entry_point", "simultaneous"), [("pettingzoo.classic.tictactoe_v3", False), ("mpe2.simple_spread_v3", True)]
)
def test_a_game_comes_step_by_step(entry_point: str, simultaneous: bool) -> None:
    config = league(entry_point)
    described = interface(config)
    players = {agent: policy for agent, (_, policy) in contestant("script:random", None, described).items()}
    moments = list(exhibit(stepping(config.environment, 1), players, seed=3))
    assert [moment.step for moment in moments] == list(range(len(moments)))
    assert [moment.is_over for moment in moments] == [False] * (len(moments) - 1) + [True]
    assert moments[0].moves == ()
    assert {len(moment.moves) for moment in moments[1:]} == {len(described.agents) if simultaneous else 1}
    assert sorted(ending.agent for ending in moments[-1].endings) == list(range(len(described.agents)))
    again = list(exhibit(stepping(config.environment, 1), players, seed=3))
    other = list(exhibit(stepping(config.environment, 1), players, seed=4))
    taken = [[[move.action for move in moment.moves] for moment in each] for each in (moments, again, other)]
    assert taken[0] == taken[1] != taken[2]
    assert moments[-1].returns == again[-1].returns


@pytest.mark.parametrize("entry_point", ["pettingzoo.classic.tictactoe_v3", "pettingzoo.classic.leduc_holdem_v4"])
def test_the_first_observation_in_turn_is_the_environments(entry_point: str) -> None:
    config = league(entry_point)
    env = build(config.environment)
    env.reset(seed=5)
    expected = env.observe(env.agent_selection)
    seen = first_observation(config, interface(config), None, seed=5)
    assert set(seen) == set(expected) == {"observation", "action_mask"}
    for key, value in expected.items():
        assert np.array_equal(np.array(seen[key], value.dtype), value)


def test_where_all_act_at_once_each_policy_has_a_first_observation() -> None:
    config = league("mpe2.simple_adversary_v3", policies=ROLES)
    env = build(config.environment)
    expected, _ = env.reset(seed=5)
    for policy, agent in (("adversary", "adversary_0"), ("good", "agent_0")):
        seen = first_observation(config, interface(config), policy, seed=5)
        assert np.array_equal(np.array(seen, np.float32), expected[agent])


def test_a_policy_that_does_not_begin_has_none() -> None:
    config = league("pettingzoo.classic.tictactoe_v3", policies={"first": ["player_1"], "second": ["player_2"]})
    with pytest.raises(UnknownPolicy, match=r"'second' does not begin an episode of shown \('first' does\)"):
        first_observation(config, interface(config), "second")
