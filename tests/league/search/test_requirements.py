from collections.abc import Callable, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from league.config.league import LeagueConfig
from league.environments.building import build, describe
from league.environments.vector.tictactoe import TicTacToe
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.errors import EnvironmentMismatch
from league.search.requirements import searchable
from tests.support.environments.vector_copies import Chance


def check(entry_point: str, **settings: object) -> Callable[[int], VectorEnv]:
    config = LeagueConfig.model_validate(
        {"league": "any", "environment": {"entry_point": entry_point, **settings}, "training": {"algorithm": "ppo"}}
    )
    return searchable(config.environment, describe(build(config.environment), config))


class Forgetful(TicTacToe):
    """Keeps a part of its state where `copy` does not expect it."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self._kept = [self._boards]
        del self._boards

    def __getattr__(self, name: str) -> object:
        if name == "_boards":
            return self._kept[0]
        raise AttributeError(name)


class Unrestored(TicTacToe):
    """Does not implement `restore`."""

    restore = VectorEnv.restore


class Doubled(TicTacToe):
    """A win counts 2."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[np.int64]) -> Sequence[AgentRows]:
        (rows,) = super().step(env_ids, actions)
        rows.rewards[:] *= 2
        return (rows,)


def test_games_with_perfect_information_can_be_searched() -> None:
    for name in ("connect_four_v3", "tictactoe_v3"):
        assert check(f"pettingzoo.classic.{name}")(3).num_envs == 3
    for entry_point, reason in (
        ("pettingzoo.classic.leduc_holdem_v4", "agents do not see everything"),
        ("pettingzoo.classic.rps_v2", "agents do not see everything"),
        ("mpe2.simple_spread_v3", "agents do not see everything"),
        ("pettingzoo.classic.go_v5", "only vectorised environments can be searched. It is stepped in lockstep"),
    ):
        with pytest.raises(EnvironmentMismatch, match=f"{entry_point} cannot be searched: {reason}") as refused:
            check(entry_point)
        assert "\n" not in str(refused.value)


def test_a_game_that_search_versions_cannot_play_is_refused() -> None:
    for game, reason in (
        (Forgetful, r"its VectorEnv\.copy does not copy everything: (copy|row) "),
        (Unrestored, r"does not implement VectorEnv\.restore"),
        (Doubled, "not from -1 to 1"),
        (Chance, r"cannot be searched: its games depend on chance: copy \d+, seed "),
    ):
        with pytest.raises(EnvironmentMismatch, match=reason):
            check("pettingzoo.classic.tictactoe_v3", vector=f"{game.__module__}:{game.__name__}")
