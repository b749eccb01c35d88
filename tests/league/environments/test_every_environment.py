"""All environments of PettingZoo 1.27 and mpe2 except Atari run in lockstep, and their episodes depend only on their
seeds: not on the environment's index, its earlier episodes, or the other environments.
"""

from typing import Any

import pytest

from league.config.environment import EnvironmentConfig
from league.environments.building import action_space, build
from league.environments.lockstep import stock_stepping
from tests.conformance.stepping import Reports, assert_same_episode, lockstep

STEPS = 13
ENVIRONMENTS: dict[str, dict[str, Any]] = {
    "pettingzoo.classic.chess_v6": {},
    "pettingzoo.classic.connect_four_v3": {},
    "pettingzoo.classic.go_v5": {"board_size": 5},
    "pettingzoo.classic.hanabi_v5": {},
    "pettingzoo.classic.leduc_holdem_v4": {},
    "pettingzoo.classic.rps_v2": {},
    "pettingzoo.classic.texas_holdem_v4": {},
    "pettingzoo.classic.texas_holdem_no_limit_v6": {},
    "pettingzoo.classic.tictactoe_v3": {},
    "pettingzoo.butterfly.cooperative_pong_v6": {},
    "pettingzoo.butterfly.knights_archers_zombies_v11": {"spawn_delay": 2},
    "pettingzoo.butterfly.pistonball_v6": {"n_pistons": 3},
    "pettingzoo.sisl.multiwalker_v9": {},
    "pettingzoo.sisl.pursuit_v5": {},
    "mpe2.simple_v3": {},
    "mpe2.simple_adversary_v3": {},
    "mpe2.simple_crypto_v3": {},
    "mpe2.simple_push_v3": {},
    "mpe2.simple_reference_v3": {},
    "mpe2.simple_speaker_listener_v4": {},
    "mpe2.simple_spread_v3": {"continuous_actions": True},
    "mpe2.simple_tag_v3": {},
    "mpe2.simple_world_comm_v3": {},
}


@pytest.mark.parametrize("entry_point", ENVIRONMENTS)
def test_an_episode_depends_on_its_seed_only(entry_point: str) -> None:
    config = EnvironmentConfig(entry_point=entry_point, kwargs=ENVIRONMENTS[entry_point])
    env = build(config)
    spaces = {agent: action_space(env, agent) for agent in env.possible_agents}
    envs = stock_stepping(config, 2)
    first = lockstep(envs, spaces, [3, 4], STEPS)
    assert sum(len(reports) for reports in first[3].values()) > 2

    again = lockstep(envs, spaces, [4, 3], STEPS)
    elsewhere = lockstep(stock_stepping(config, 1), spaces, [3], STEPS)
    for seed, episode in again.items():
        assert_same_episode(episode, first[seed])
    assert_same_episode(elsewhere[3], first[3])
    assert _observations_change(first[3]), "no observation changes"


def _observations_change(episode: Reports) -> bool:
    """Whether an observation of any agent changes."""
    return any(
        report[1][name].tobytes() != reports[0][1][name].tobytes()
        for reports in episode.values()
        for report in reports
        for name in report[1]
    )
