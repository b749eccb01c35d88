"""The memory of recurrent opponents."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.config.opponents import OpponentConfig
from league.environments.stepping import Batch, Turn
from league.environments.vector.vector_env import AgentRows
from league.results.records import Scoring
from league.results.scoring import scores
from tests.support.leagues.registries import interface
from tests.support.policies.bots import MODULE
from training.sampling.opponent_scores import MOST_WAITING, OpponentResults, OpponentScores, OpposedGames
from training.sampling.opponents import OpponentPolicy, Opponents
from training.sampling.recurrent_state import RecurrentStates

RETURNS = st.sampled_from([-1.0, 0.0, 0.25, 7.0])
GAMES = st.lists(st.tuples(RETURNS, RETURNS), max_size=8)
TWO_SIDES = np.eye(2, dtype=bool)


@given(GAMES)
def test_games_are_scored_as_in_matches(games: list[tuple[float, float]]) -> None:
    returns, of_others = (np.array([game[i] for game in games]) for i in range(2))
    numbers = np.zeros(len(games), int)
    results = OpposedGames(numbers, numbers, returns, of_others[:, np.newaxis]).scores()
    assert results.tolist() == [scores([game], "game")[0][0] for game in games]


@given(st.tuples(RETURNS, RETURNS), st.tuples(RETURNS, RETURNS))
def test_two_games_form_a_block_if_sides_differ(first: tuple[float, float], second: tuple[float, float]) -> None:
    returns, of_others = np.array([second[0], first[0]]), np.array([[second[1]], [first[1]]])
    block, waiting = OpposedGames(np.zeros(2, int), np.array([1, 0]), returns, of_others).blocks()
    expected = scores([first, second], "side")
    assert len(waiting.own) == 0
    assert block.scores().sum() == sum(float(game[0] or 0) for game in expected)
    for opponents, sides in (([0, 0], [1, 1]), ([0, 1], [1, 0])):
        block, waiting = OpposedGames(np.array(opponents), np.array(sides), returns, of_others).blocks()
        assert (len(block.own), sorted(waiting.own)) == (0, sorted(returns))


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
    results = collected.take(2)
    assert (results.games.tolist(), results.scores.tolist()) == ([1, 0], [1.0, 0.0])
    collected.add_turn(Turn(endings=[rows([0, 0], [0, 1], [1.0, 1.0])], finished=np.array([0])))
    results = collected.take(2)
    assert (results.games.tolist(), results.scores.tolist()) == ([0, 1], [0.0, 0.5])


def play(collected: OpponentScores, opponents: list[int], sides: list[int], own: list[float]) -> OpponentResults:
    """Results after a game in each environment. own: the learner's returns; those of the other sides are 0."""
    envs = np.arange(len(sides))
    collected.begin(envs, np.array(opponents), np.array(sides))
    collected.add_turn(Turn())
    collected.add_turn(Turn(endings=[rows(envs.tolist(), sides, own)], finished=envs))
    return collected.take(2)


def test_a_game_waits_for_its_partner() -> None:
    collected = OpponentScores(TWO_SIDES, "side", num_envs=2)
    results = play(collected, [0, 1], [0, 1], [1.0, 1.0])
    assert (results.episodes.tolist(), results.games.tolist()) == ([1, 1], [0, 0])
    results = play(collected, [0, 0], [1, 1], [0.0, 5.0])
    assert (results.episodes.tolist(), results.games.tolist(), results.scores.tolist()) == ([2, 0], [2, 0], [1.5, 0.0])
    results = play(collected, [0, 1], [0, 0], [0.0, 0.0])
    assert (results.episodes.tolist(), results.games.tolist(), results.scores.tolist()) == ([1, 1], [2, 2], [1.5, 1.5])


def test_the_newest_games_wait() -> None:
    collected, many = OpponentScores(TWO_SIDES, "side", num_envs=40), [0] * 40
    returns = [0.0] * (40 - MOST_WAITING) + [1.0] * MOST_WAITING
    assert play(collected, many, many, returns).games.tolist() == [0, 0]
    results = play(collected, many, [1] * 40, [1.0] * 40)
    assert (results.games[0], results.scores[0]) == (2 * MOST_WAITING, 2 * MOST_WAITING), "all games with returns of 1"


@pytest.mark.parametrize(("scoring", "sides"), [("side", 3), ("team", 2)])
def test_episodes_of_unscored_leagues_are_counted(scoring: Scoring, sides: int) -> None:
    collected = OpponentScores(np.eye(sides, dtype=bool), scoring, num_envs=3)
    results = play(collected, [1, 1, -1], [0, 1, 0], [1.0, 1.0, 1.0])
    assert (results.episodes.tolist(), results.games.tolist()) == ([0, 2], [0, 0])


@pytest.mark.parametrize("side", [0, 1, 2])
def test_the_other_sides_are_compared_one_by_one(side: int) -> None:
    """Sides of 2, 1 and 1 agents; in side 0 the order of the agents' returns must not matter."""
    members = np.array([[True, True, False, False], [False, False, True, False], [False, False, False, True]])
    collected = OpponentScores(members, "game", num_envs=1)
    collected.begin(np.arange(1), np.array([0]), np.array([side]))
    collected.add_turn(Turn())
    collected.add_turn(Turn(endings=[rows([0] * 4, [0, 1, 2, 3], [0.1, 0.3, 0.0, 0.5])], finished=np.array([0])))
    expected = {0: 0.5, 1: 0.0, 2: 1.0}[side]  # 0.2 against 0 and 0.5, 0 against 0.2 and 0.5, 0.5 against 0.2 and 0
    assert collected.take(1).scores.tolist() == [expected]


@pytest.mark.parametrize("sides", [2, 3, 5])
def test_equal_policies_score_a_half(sides: int) -> None:
    """One side wins, each of them as often."""
    collected = OpponentScores(np.eye(sides, dtype=bool), "game", num_envs=sides)
    envs = np.arange(sides)
    collected.begin(envs, np.zeros(sides, int), np.zeros(sides, int))
    collected.add_turn(Turn())
    collected.add_turn(Turn(endings=[rows(envs.tolist(), envs.tolist(), [1.0] * sides)], finished=envs))
    results = collected.take(1)
    assert (results.games.tolist(), results.scores.tolist()) == ([sides], [pytest.approx(sides / 2)])


def test_opponents_forget_what_happened_in_earlier_episodes() -> None:
    opponents = Opponents([], interface(), None, num_envs=3)
    states = RecurrentStates({"h": np.zeros(2, np.float32)}, num_envs=3, agents=2)
    opponents._recurrent_states[OpponentPolicy("board@1", "shared")] = states
    envs = np.arange(3)
    batch = Batch(envs, np.zeros(3, np.int64), {}, np.zeros(3))
    states.update(batch, {"h": np.ones((3, 2), np.float32)})
    opponents.forget(np.array([0, 2]))
    np.testing.assert_array_equal(states.get(batch)["h"], [[0, 0], [1, 1], [0, 0]])


def test_bots_have_one_instance_for_each_agent_and_episode() -> None:
    ref = f"script:{MODULE}:Alternating"
    opponents = Opponents([OpponentConfig(ref=ref, share=1.0)], interface(), None, num_envs=2)
    observations = {"observation": np.zeros((2, 3, 3, 2), np.int8), "action_mask": np.ones((2, 9), np.int8)}
    batch = Batch(np.arange(2), np.zeros(2, np.int64), observations, np.zeros(2))

    def act() -> list[int]:
        return opponents.act(OpponentPolicy(ref, "shared"), batch, np.random.default_rng(0)).tolist()

    assert act() == [8, 8]
    opponents.forget(np.array([0]))
    assert act() == [8, 0]
