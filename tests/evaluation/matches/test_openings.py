import numpy as np
import pytest

from evaluation.matches.openings import OpeningMoves
from league.environments.stepping import Batch
from league.random.seeds import generator
from tests.support.environments.kinds import KINDS, Kind

TEAM, CONTINUOUS = KINDS["team"], KINDS["continuous team"]


@pytest.mark.parametrize(("kind", "shape"), [(TEAM, ()), (CONTINUOUS, (5,))], ids=["discrete", "continuous"])
def test_actions_use_the_numbers_of_the_generators_of_their_games(kind: Kind, shape: tuple[int, ...]) -> None:
    """Each agent continues its own numbers, and restarted openings have others."""
    seeds = np.array([3, 2**62, 2**31])
    openings = OpeningMoves(kind.interface, agents=3, seeds=seeds, plies=4)
    rngs = {(game, agent): generator(int(seeds[game]), "opening", 0, agent) for game in range(3) for agent in range(3)}
    rng = np.random.default_rng(0)
    for turn in range(4):
        if turn == 2:
            openings.restart(np.array([1]), np.array([7]))
            rngs |= {(1, agent): generator(2**62, "opening", 7, agent) for agent in range(3)}
        games, agents = np.array([0, 1, 1, 2]), rng.integers(3, size=4)
        agents[2] = (agents[1] + 1) % 3
        observation = np.zeros((4, 18), np.float32)
        actions = openings.act("shared", Batch(np.arange(4), agents, {"observation": observation}, np.zeros(4)), games)
        expected = [
            rngs[game, agent].random(shape) for game, agent in zip(games.tolist(), agents.tolist(), strict=True)
        ]
        scaled = np.array(expected) if shape else np.floor(np.array(expected) * 5)
        np.testing.assert_array_equal(actions, scaled.astype(actions.dtype))


def test_schedules_without_openings_need_no_numbers() -> None:
    assert OpeningMoves(TEAM.interface, agents=3, seeds=np.array([1]), plies=0)
