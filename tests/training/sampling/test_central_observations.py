"""What central critics get, in episodes with everything the protocol allows."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.environments.building import interface
from league.errors import ConfigError
from league.random.seeds import generator
from tests.support.environments import scripted_environment
from tests.support.environments.scripted_environment import Scripted
from tests.support.leagues.training_leagues import counting, solvable
from tests.support.learners import episodes_of
from tests.support.policies.self_play import FRAGMENT_LENGTHS, INITIAL, forward
from training.sampling.central_observations import PRESENT, STATE, central_space
from training.sampling.episode_chunks import EpisodeChunks
from training.sampling.recorder import EpisodeRecorder
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import SelfPlay

TWO: Any = {"a": ["player_0"], "b": ["player_1"]}


@given(
    agents=st.integers(2, 4),
    num_envs=st.integers(1, 3),
    crashing=st.sampled_from([0.0, 0.3]),
    fragment_lengths=FRAGMENT_LENGTHS,
)
@settings(max_examples=20)
def test_others_are_of_the_same_episode_and_absent_ones_are_zeros(
    agents: int, num_envs: int, crashing: float, fragment_lengths: list[int]
) -> None:
    env, described = Scripted(agents, num_envs, crashing), scripted_environment.interface(agents)
    recorder = EpisodeRecorder(described, env.agents, num_envs, "central")
    league = solvable("discrete")
    play = SelfPlay(env, described, league.training, recorder, INITIAL, None, opening_plies=0)
    play.begin(ResetSeeds.of_run(3, runner=0, runners=1, num_envs=num_envs, steps=0), generator(3, "play", 0))
    for steps in fragment_lengths:
        for _ in range(steps):
            play.step(forward, explore=True)
        for chunks in recorder.cut():
            check(chunks, env)


def check(chunks: EpisodeChunks, env: Scripted) -> None:
    """An observation is (agent, seed of the episode, number of the agent's earlier rows)."""
    number = np.repeat(chunks.agents, chunks.lengths + 1)
    observed, present = chunks.observations["observation"], chunks.central[PRESENT]
    for agent, name in enumerate(env.agents):
        column, is_present = chunks.central[f"central/{name}/observation"], present[:, agent] == 1
        np.testing.assert_array_equal(column[number == agent], observed[number == agent])
        assert is_present[number == agent].all()
        np.testing.assert_array_equal(
            column[is_present, :2], np.stack([np.full(is_present.sum(), agent), observed[is_present, 1]], 1)
        )
        assert not column[~is_present].any()
        for seed, rows in zip(observed[is_present, 1].tolist(), column[is_present, 2].tolist(), strict=True):
            assert rows <= len(env.played[int(seed)].agents[agent].groups)


def test_in_a_turn_based_game_others_are_as_at_their_last_turns() -> None:
    """Before its first turn a player is absent, as it is after it has left."""
    league = counting([3, 4], [1], critic="central", num_envs=1, gamma=1.0)
    first, second = episodes_of(league, steps=12)
    steps = first.lengths[0] + 1
    assert first.observations["observation"][:steps, 1].tolist() == [0, 1, 2, 3]
    # The row in which player_0 leaves has what player_1 observes then.
    assert first.central["central/player_1/observation"][:steps, :2].tolist() == [[0, 0], [1, 0], [1, 1], [1, 2]]
    assert first.central[PRESENT][:steps].tolist() == [[1, 0], [1, 1], [1, 1], [1, 1]]
    steps = second.lengths[0] + 1
    assert second.observations["observation"][:steps, 1].tolist() == [0, 1, 2, 3, 4]
    assert second.central["central/player_0/observation"][:steps, 1].tolist() == [0, 1, 0, 0, 0]
    assert second.central[PRESENT][:steps].tolist() == [[1, 1], [1, 1], [0, 1], [0, 1], [0, 1]]


@pytest.mark.parametrize("critic", ["central", "state"])
def test_agents_that_act_at_once_see_each_other_at_the_same_time(critic: str) -> None:
    """Also after the last step of an episode, where the state is not that of the next episode."""
    a, b = episodes_of(solvable("watching", policies=TWO, critic=critic, num_envs=3), steps=40)
    pair = np.stack([a.observations["observation"], b.observations["observation"]], 1)
    for chunks in (a, b):
        assert chunks.truncated.any()
        if critic == "state":
            np.testing.assert_array_equal(chunks.central[STATE], pair)
        else:
            columns = [chunks.central[f"central/player_{i}/observation"] for i in range(2)]
            np.testing.assert_array_equal(np.stack(columns, 1), pair)
            assert chunks.central[PRESENT].all()


def test_nothing_is_recorded_for_a_critic_of_its_own_agent() -> None:
    assert all(not chunks.central for chunks in episodes_of(solvable("watching"), steps=16))


def test_an_environment_without_a_state_is_rejected() -> None:
    league = solvable("discrete", {"agents": 2})
    with pytest.raises(ConfigError, match=r"training\.critic: state needs an environment with a method state\(\)"):
        central_space("state", league.environment, interface(league))
