"""Two learners in two processes, on the same sample: an update equals that of one learner."""

import multiprocessing
from collections.abc import Iterator
from contextlib import nullcontext
from multiprocessing.connection import Connection
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from league.config.league import LeagueConfig
from tests.support.leagues.training_leagues import counting, solvable, tictactoe
from tests.support.learners import episodes_of, learner_of
from training.learners.ppo import PPOLearner
from training.learners.ranks import Rank, TCPStore, connect
from training.rllib_compat import TrainingData
from training.sampling.episode_chunks import EpisodeChunks

CONNECT_FOUR = {
    "league": "connect_four",
    "environment": {"entry_point": "pettingzoo.classic.connect_four_v3"},
    "training": {"runners": 0, "num_envs": 8, "convolutions": [{"filters": 8, "kernel": 4}], "hidden": [16]},
}
TWO: dict[str, Any] = {"kwargs": {"agents": 2}, "policies": {"a": ["player_0"], "b": ["player_1"]}}
LEAGUES = {
    "an MLP": tictactoe(),
    "convolutions": LeagueConfig.from_mapping(CONNECT_FOUR),
    "a recurrent policy": solvable("remembering", recurrence={"width": 16, "sequence": 8}),
    "a shared encoder": solvable("discrete", **TWO, shared_encoder=True),
    "normalised observations": solvable("far_numbers", normalize_observations=True),
    "a magnet": tictactoe(magnet={"ref": "previous", "every": 2, "weight": 0.1}),
    "central critics": solvable("watching", policies=TWO["policies"], critic="central", normalize_values=True),
    "a policy with few steps": counting([40, 1], [0, 0], num_envs=4),
}
UPDATES = 2


def updates(league: LeagueConfig, episodes: list[EpisodeChunks], rank: Rank) -> tuple[dict, dict, dict]:
    """Return metrics, weights and the optimisers' state of a learner after some updates."""
    torch.manual_seed(7)
    learner = learner_of(league)
    learner.rank = rank
    data = TrainingData(episodes=episodes)
    with patch("training.learners.ppo.fast_products", nullcontext):  # bfloat16 rounds sums of other rows differently
        for _ in range(UPDATES):
            metrics = learner.update(training_data=data, num_epochs=2, minibatch_size=64)
    optimizers = {
        f"{name} {place} {key}": value
        for name, optimizer in learner._optimizers.items()
        for place, state in optimizer.state_dict()["state"].items()
        for key, value in state.items()
    }
    logged = {f"{policy} {name}": float(stats.peek()) for policy, row in metrics.items() for name, stats in row.items()}
    return logged, weights(learner), {name: value.numpy() for name, value in optimizers.items()}


def weights(learner: PPOLearner) -> dict[str, np.ndarray]:
    return {
        f"{policy} {name}": array
        for policy, module in learner.module.items()
        for name, array in module.get_state().items()
    }


def second_learner(pipe: Connection, port: int) -> None:
    """The other process: updates a learner on each sample from the pipe, and answers with its state."""
    torch.set_num_threads(1)
    rank = Rank(1, 2)
    connect(rank, TCPStore("127.0.0.1", port, 2), "gloo")
    while (sample := pipe.recv()) is not None:
        pipe.send(updates(*sample, rank))


@pytest.fixture(scope="module")
def second() -> Iterator[Connection]:
    store = TCPStore("127.0.0.1", 0, 2, is_master=True, wait_for_workers=False)
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=second_learner, args=(there, store.port), daemon=True)
    process.start()
    connect(Rank(0, 2), store, "gloo")
    yield here
    torch.distributed.destroy_process_group()
    here.send(None)
    process.join()


@pytest.mark.parametrize("name", LEAGUES)
def test_an_update_of_two_learners_equals_that_of_one(name: str, second: Connection) -> None:
    league = LEAGUES[name]
    episodes = episodes_of(league)
    expected_metrics, expected_weights, _ = updates(league, episodes, Rank())
    second.send((league, episodes))
    metrics, first_weights, moments = updates(league, episodes, Rank(0, 2))
    other_metrics, other_weights, other_moments = second.recv()
    assert metrics == pytest.approx(expected_metrics, rel=1e-3, abs=1e-4)
    for name, array in expected_weights.items():
        assert first_weights[name] == pytest.approx(array, rel=1e-4, abs=1e-5)
    assert metrics == other_metrics
    for mine, theirs in ((first_weights, other_weights), (moments, other_moments)):
        assert mine.keys() == theirs.keys()
        assert all(np.array_equal(mine[name], theirs[name]) for name in mine)


def test_a_gradient_that_is_not_finite_for_one_learner_is_skipped_by_both(second: Connection) -> None:
    league = LEAGUES["an MLP"]
    (episodes,) = episodes_of(league)
    episodes.log_p[0] = np.nan
    before = weights(learner_of(league))
    second.send((league, [episodes]))
    _, first_weights, moments = updates(league, [episodes], Rank(0, 2))
    _, other_weights, other_moments = second.recv()
    assert any(not np.array_equal(before[name], first_weights[name]) for name in before), "most minibatches are finite"
    assert all(np.isfinite(array).all() for array in first_weights.values())
    assert all(np.array_equal(first_weights[name], other_weights[name]) for name in before)
    assert all(np.array_equal(moments[name], other_moments[name]) for name in moments)


@given(st.integers(1, 40), st.integers(1, 6), st.booleans())
def test_shares_are_all_units_and_fractions_add_up(number: int, count: int, in_sequences: bool) -> None:
    units = torch.randperm(number)
    lengths = torch.randint(1, 9, (number,)) if in_sequences else None
    shares = [Rank(index, count).share(units, lengths) for index in range(count)]
    assert sum(fraction for _, fraction in shares) == pytest.approx(1)
    assert torch.equal(torch.cat([part for part, fraction in shares if fraction]), units)
    assert all(len(part) for part, _ in shares)
