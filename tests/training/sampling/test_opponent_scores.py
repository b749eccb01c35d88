import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.environments.stepping import Batch, Turn
from league.environments.vector.vector_env import AgentRows
from league.results.scoring import scores
from training.sampling.opponent_scores import OpponentScores, OpposedGames

RETURNS = st.sampled_from([-1.0, 0.0, 0.25, 7.0])
GAMES = st.lists(st.tuples(st.integers(0, 2), RETURNS, RETURNS), max_size=8)
TWO_SIDES = np.eye(2, dtype=bool)


@given(GAMES)
def test_games_are_scored_as_in_matches(games: list[tuple[int, float, float]]) -> None:
    opponents, own, other = (np.array([game[i] for game in games]) for i in range(3))
    found = OpposedGames(opponents.astype(int), np.zeros(len(games), int), own, other).scored("game", 3)
    for number in range(3):
        expected = [scores([(mine, theirs)], "game")[0][0] for of, mine, theirs in games if of == number]
        assert found.games[number] == len(expected)
        assert float(found.scores[number]) == sum(float(score or 0) for score in expected)


@given(st.tuples(RETURNS, RETURNS), st.tuples(RETURNS, RETURNS))
def test_two_games_form_a_block_if_sides_differ(first: tuple[float, float], second: tuple[float, float]) -> None:
    own, other = np.array([second[0], first[0]]), np.array([second[1], first[1]])
    block = OpposedGames(np.zeros(2, int), np.array([1, 0]), own, other).scored("side", 1)
    expected = scores([first, second], "side")
    assert block.games.tolist() == [2]
    assert float(block.scores[0]) == sum(float(game[0] or 0) for game in expected)
    alone = OpposedGames(np.zeros(2, int), np.array([1, 1]), own, other).scored("side", 1)
    assert alone.games.tolist() == [0]


def rows(envs: list[int], agents: list[int], rewards: list[float]) -> AgentRows:
    ends = np.ones(len(envs), bool)
    return AgentRows(np.array(envs), np.array(agents), {}, np.array(rewards), ends, ~ends)


def batch(envs: list[int], agents: list[int], rewards: list[float]) -> Batch:
    return Batch(np.array(envs), np.array(agents), {}, np.array(rewards))


def test_rewards_of_an_episode_are_summed_for_both_sides() -> None:
    collected = OpponentScores(TWO_SIDES, "game", num_envs=3)
    collected.begin(np.arange(3), np.array([0, -1, 0]), np.array([1, 0, 0]))
    collected.add_turn(Turn({0: batch([0, 1, 2], [0, 0, 0], [0.0, 0.0, 0.0])}))
    collected.add_turn(Turn({0: batch([0, 1, 2], [1, 1, 1], [2.0, 5.0, 9.0])}))
    # Another opponent begins in the same call in which the episodes end; one environment crashes.
    collected.begin(np.arange(3), np.array([1, 1, 1]), np.array([0, 0, 0]))
    ended = Turn(
        {0: batch([0, 1, 2], [0, 0, 0], [0.0, 0.0, 0.0])},
        endings=[rows([0, 0, 1, 1], [0, 1, 0, 1], [1.0, 0.0, 0.0, 0.0])],
        finished=np.array([0, 1]),
        crashed=np.array([2]),
    )
    collected.add_turn(ended)
    found = collected.take(2)
    assert (found.games.tolist(), found.scores.tolist()) == ([1, 0], [1.0, 0.0])
    collected.add_turn(Turn(endings=[rows([0, 0], [0, 1], [1.0, 1.0])], finished=np.array([0])))
    found = collected.take(2)
    assert (found.games.tolist(), found.scores.tolist()) == ([0, 1], [0.0, 0.5])


@pytest.mark.parametrize("side", [0, 1, 2])
def test_the_other_sides_count_by_their_mean(side: int) -> None:
    """Sides of 2, 1 and 1 agents; in side 0 the order of the agents' returns must not matter."""
    members = np.array([[True, True, False, False], [False, False, True, False], [False, False, False, True]])
    collected = OpponentScores(members, "game", num_envs=1)
    collected.begin(np.arange(1), np.array([0]), np.array([side]))
    collected.add_turn(Turn())
    collected.add_turn(Turn(endings=[rows([0] * 4, [0, 1, 2, 3], [0.1, 0.3, 0.0, 0.5])], finished=np.array([0])))
    expected = {0: 0.0, 1: 0.0, 2: 1.0}[side]  # 0.2 against 0.25, 0 against 0.35, 0.5 against 0.1
    assert collected.take(1).scores.tolist() == [expected]
