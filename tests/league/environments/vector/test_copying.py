from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.building import agent_interface, build
from league.environments.implementation import VECTORISED, implementation
from league.environments.stepping import legal_rows
from league.environments.vector.connect_four import ConnectFour
from league.environments.vector.copying import Twins
from league.environments.vector.differences import EnvironmentsDiffer
from league.environments.vector.random_actions import random_actions
from league.environments.vector.tictactoe import TicTacToe
from league.environments.vector.vector_env import AgentRows
from league.errors import ObservationError
from league.spaces import Discrete
from league.spaces.conversion import from_gymnasium
from tests.support.environments.vector_copies import Chance


def twins(config: EnvironmentConfig) -> Twins:
    vector, env = implementation(config).vector, build(config)
    assert vector is not None
    actions = [agent_interface(env, agent).action for agent in env.possible_agents]
    env.close()
    return Twins(partial(vector, **config.kwargs), actions)


@pytest.mark.parametrize("entry_point", VECTORISED)
def test_copied_episodes_continue_identically(entry_point: str) -> None:
    wrappers: list[Any] = [{"frame_stack_v1": {"stack_size": 3}}]
    for wrapped in ([], wrappers) if entry_point == "mpe2.simple_spread_v3" else ([],):
        twins(EnvironmentConfig.model_validate({"entry_point": entry_point, "wrappers": wrapped})).check_copying()


def test_board_games_are_restored_from_observations() -> None:
    for game, actions in ((ConnectFour, 7), (TicTacToe, 9)):
        Twins(game, [Discrete(n=actions)] * 2).check_restoring()


def test_what_is_not_a_position_is_refused(subtests: pytest.Subtests) -> None:
    for game, pieces, other in (
        (TicTacToe, [0, 1], [2]),  # the other player must move
        (TicTacToe, [0], [1, 2, 3]),
        (TicTacToe, [0], [0]),
        (TicTacToe, [3, 4], [0, 1, 2]),  # lost
        (TicTacToe, [0, 2, 5, 7], [1, 4, 3, 6, 8]),  # full
        (ConnectFour, [], [0]),  # hovers
        (ConnectFour, [35, 36, 37], [28, 29, 30, 31]),
        (ConnectFour, [28, 29, 30], [35, 36, 37, 38]),
    ):
        message = r"observation 0 is not a position .*: \d own pieces and \d of"
        with subtests.test(pieces=pieces, other=other), pytest.raises(ObservationError, match=message):
            game(1).restore(np.array([0]), {"observation": board(game, pieces, other)})


class Faulty(TicTacToe):
    """Has an error in some attribute of restored and copied episodes, or in the outcome of a seed."""

    def __init__(self, num_envs: int, attribute: str) -> None:
        super().__init__(num_envs)
        self._attribute = attribute

    def copy(self, source: NDArray[np.int64], target: NDArray[np.int64]) -> None:
        before = getattr(self, self._attribute)[target].copy()
        super().copy(source, target)
        getattr(self, self._attribute)[target] = before

    def restore(self, env_ids: NDArray[np.int64], observations: Mapping[str, NDArray[Any]]) -> Sequence[AgentRows]:
        before = getattr(self, self._attribute)[env_ids].copy()
        rows = super().restore(env_ids, observations)
        getattr(self, self._attribute)[env_ids] = before
        return rows


@pytest.mark.parametrize("attribute", ["_planes", "_masks", "_moves", "_boards"])
@pytest.mark.parametrize(
    ("check", "other"), [(Twins.check_copying, "the copied episode"), (Twins.check_restoring, "the restored episode")]
)
def test_each_part_of_the_state_is_compared(attribute: str, check: Callable[[Twins], None], other: str) -> None:
    with pytest.raises(EnvironmentsDiffer, match=rf"(copy|row) .* in {other}"):
        check(Twins(lambda copies: Faulty(copies, attribute), [Discrete(n=9)] * 2))


def test_games_of_chance_are_recognised() -> None:
    Twins(TicTacToe, [Discrete(n=9)] * 2).check_without_chance()
    Twins(Chance, [Discrete(n=9)] * 2).check_copying()
    with pytest.raises(EnvironmentsDiffer, match=r"rewards is .* in the episode with another seed"):
        Twins(Chance, [Discrete(n=9)] * 2).check_without_chance()


def board(game: type[TicTacToe] | type[ConnectFour], own: list[int], other: list[int]) -> NDArray[np.int8]:
    shape = (3, 3, 2) if game is TicTacToe else (6, 7, 2)
    planes = np.zeros((shape[0] * shape[1], 2), dtype=np.int8)
    planes[own, 0] = planes[other, 1] = 1
    return planes.reshape(1, *shape)


SPACES = {
    "discrete": gymnasium.spaces.Discrete(5),
    "from 3": gymnasium.spaces.Discrete(5, start=3),
    "several choices": gymnasium.spaces.MultiDiscrete([2, 3]),
    "binary": gymnasium.spaces.MultiBinary(4),
    "box": gymnasium.spaces.Box(-1, 2, (2, 2), np.float32),
    "half a box": gymnasium.spaces.Box(np.array([0, -np.inf]), np.array([1, np.inf]), dtype=np.float64),
}


def test_all_legal_actions_are_equally_probable() -> None:
    mask = np.tile(np.array([0, 1, 1, 0, 1], dtype=np.int8), (30_000, 1))
    counts = np.bincount(random_actions(from_gymnasium(SPACES["discrete"]), 30_000, mask, np.random.default_rng(0)))
    assert counts[[0, 3]].tolist() == [0, 0]
    # Six standard deviations of a binomial distribution.
    assert (abs(counts[[1, 2, 4]] - 10_000) < 6 * np.sqrt(30_000 * 2 / 9)).all()


def test_actions_are_in_the_space_and_differ(subtests: pytest.Subtests) -> None:
    for name, space in SPACES.items():
        with subtests.test(name):
            actions = random_actions(from_gymnasium(space), 200, None, np.random.default_rng(0))
            assert len(actions) == 200
            assert actions.dtype == space.dtype
            assert all(space.contains(action) for action in actions)
            assert len(np.unique(actions, axis=0)) > 3
            assert name != "box" or {-1.0, 2.0} <= set(actions.ravel().tolist()), "some elements are at the bounds"


def test_masked_actions_are_legal() -> None:
    rng = np.random.default_rng(0)
    for name in ("discrete", "from 3", "several choices"):
        mask = (rng.random((300, 5)) < 0.4).astype(np.int8)
        mask[:, [0, 2]] = 1  # at least one choice for each element
        space = from_gymnasium(SPACES[name])
        assert legal_rows(random_actions(space, 300, mask, rng), space, mask).all()
