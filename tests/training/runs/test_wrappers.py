import re
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from league.config.league import LeagueConfig
from league.environments.building import build, interface
from league.errors import ConfigError
from training.runs.train import check

STEP_COST = {"policy_league.examples.extending.shaping:StepCost": {"cost": 100.0}}


class Noisy(BaseParallelWrapper):
    """Appends a number to observations."""

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        space = self.env.observation_space(agent)
        return gymnasium.spaces.Box(-np.inf, np.inf, (space.shape[0] + 1,), np.float32)


class Unbuilt(BaseParallelWrapper):
    def __init__(self, env: ParallelEnv) -> None:
        raise KeyError("cost")


def league(training: list[Any], environment: list[Any] | None = None) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "wrappers": environment or []},
            "sides": {"team": ["agent_*"]},
            "training": {"wrappers": training, "runners": 0},
        }
    )


def first_reward(config: Any) -> float:
    env = build(config)
    env.reset(seed=1)
    _, rewards, *_ = env.step(dict.fromkeys(env.agents, 0))
    env.close()
    return float(rewards["agent_0"])


def test_wrappers_of_training_do_not_change_the_game() -> None:
    config, plain = league([STEP_COST]), league([])
    check(config, interface(config))
    assert config.game_digest() == plain.game_digest()
    assert config.environment.digest() == plain.environment.digest()
    assert first_reward(config.training_environment) == pytest.approx(first_reward(config.environment) - 100)
    assert list(config.training_code()) == list(STEP_COST)


def test_wrappers_of_the_environment_are_part_of_the_game() -> None:
    game = league([], [STEP_COST]).game()
    assert f"environment.wrappers.{next(iter(STEP_COST))}" in game
    assert league([], [STEP_COST]).environment.digest() != league([]).environment.digest()


@pytest.mark.parametrize(
    ("wrapper", "problem"),
    [
        (f"{__name__}:Noisy", r"agent_0 has observations in .*shape=\(19,\).* in training, but in "
                              r".*shape=\(18,\).* in matches"),
        (f"{__name__}:Unbuilt", r"Unbuilt \(number 1\) cannot be created \(.*test_wrappers\.py, line \d+\): KeyError"),
        (f"{__name__}:first_reward", r"first_reward \(number 1\) cannot be created"),
        (f"{__name__}:str", r"has no 'str'"),
    ],
)  # fmt: skip
def test_a_wrapper_that_does_not_fit_is_refused(wrapper: str, problem: str) -> None:
    config = league([wrapper])
    with pytest.raises(ConfigError, match=re.compile(r"^training\.wrappers: .*" + problem)):
        check(config, interface(config))
