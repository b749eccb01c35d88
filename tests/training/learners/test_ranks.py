"""Two learners on the same sample: an update equals that of one learner."""

import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from threading import Semaphore
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.config.league import LeagueConfig
from tests.support.closeness import close
from tests.support.leagues.training_leagues import counting, small, solvable, tictactoe
from tests.support.learners import episodes_of, equal, learner_of, update, weights
from training.learners.ranks import Rank, TCPStore, connect
from training.sampling.episode_chunks import EpisodeChunks

TWO: dict[str, Any] = {"kwargs": {"agents": 2}, "policies": {"a": ["player_0"], "b": ["player_1"]}}
LEAGUES = {
    "an MLP": tictactoe(),
    "convolutions": small("pettingzoo.classic.connect_four_v3", convolutions=[{"filters": 8, "kernel": 4}]),
    "a recurrent policy": solvable("remembering", recurrence={"width": 16, "sequence": 8}),
    "a shared encoder": solvable("discrete", **TWO, shared_encoder=True),
    "normalised observations": solvable("far_numbers", normalize_observations=True),
    "a magnet": tictactoe(magnet={"ref": "previous", "every": 2, "weight": 0.1}),
    "central critics": solvable("watching", policies=TWO["policies"], critic="central", normalize_values=True),
    "a policy with few steps": counting([40, 1], [0, 0], num_envs=4),
}
UPDATES = 2


Learned = tuple[dict[str, dict[str, float]], dict[str, Any], list[NDArray]]
"""Metrics, weights and the optimisers' states."""


def learned(league: LeagueConfig, episodes: list[EpisodeChunks], rank: Rank) -> Learned:
    """After some updates."""
    torch.manual_seed(7)
    learner = learner_of(league)
    learner.rank = rank
    for _ in range(UPDATES):
        metrics = update(learner, episodes)
    states = [optimizer.state_dict()["state"] for optimizer in learner._optimizers.values()]
    moments = [value.numpy() for state in states for parameter in state.values() for value in parameter.values()]
    return metrics, weights(learner), moments


class TwoLearners:
    """Two learners that take turns in this process: each computes until both have a part of a sum."""

    def __init__(self) -> None:
        self.turns = Semaphore(1), Semaphore(0)
        self.parts: list[torch.Tensor] = []
        self.of_thread = threading.local()

    def all_reduce(self, part: torch.Tensor) -> None:
        self.parts.append(part)
        if len(self.parts) == 2:
            total = torch.stack(self.parts).sum(dim=0)
            for summand in self.parts:
                summand.copy_(total)
            self.parts.clear()
        random_state = torch.get_rng_state()
        self.turns[1 - self.of_thread.index].release()
        assert self.turns[self.of_thread.index].acquire(timeout=60)
        torch.set_rng_state(random_state)

    def learned(self, league: LeagueConfig, episodes: list[EpisodeChunks]) -> list[Learned]:
        def learn(index: int) -> Learned:
            torch.set_num_threads(1)
            self.of_thread.index = index
            assert self.turns[index].acquire(timeout=60)
            try:
                return learned(league, episodes, Rank(index, 2))
            finally:
                self.turns[1 - index].release()

        with ThreadPoolExecutor(2) as threads:
            return list(threads.map(learn, range(2)))


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> TwoLearners:
    learners = TwoLearners()
    monkeypatch.setattr("training.learners.ppo.fast_products", nullcontext)  # bfloat16 rounds sums differently
    monkeypatch.setattr(torch.distributed, "all_reduce", learners.all_reduce)
    return learners


@pytest.mark.parametrize("name", LEAGUES)
def test_an_update_of_two_learners_equals_that_of_one(name: str, two: TwoLearners) -> None:
    league = LEAGUES[name]
    episodes = episodes_of(league)
    expected_metrics, expected_weights, _ = learned(league, episodes, Rank())
    (metrics, first_weights, moments), other = two.learned(league, episodes)
    for policy, row in expected_metrics.items():
        assert metrics[policy] == pytest.approx(row, rel=1e-3, abs=1e-4)
        assert close(first_weights[policy], expected_weights[policy], 1e-4)
    assert equal((metrics, first_weights, moments), other)


def test_a_gradient_that_is_not_finite_for_one_learner_is_skipped_by_both(two: TwoLearners) -> None:
    league = LEAGUES["an MLP"]
    (episodes,) = episodes_of(league)
    episodes.log_p[0] = np.nan
    torch.manual_seed(7)
    before = weights(learner_of(league))
    (_, first_weights, moments), (_, other_weights, other_moments) = two.learned(league, [episodes])
    assert not equal(before, first_weights), "most minibatches are finite"
    assert all(np.isfinite(array).all() for array in first_weights["shared"].values())
    assert equal((first_weights, moments), (other_weights, other_moments))


def test_learners_are_connected_by_the_store_of_the_first() -> None:
    connect(Rank(0, 1), TCPStore("127.0.0.1", 0, 1, is_master=True), "gloo")
    try:
        assert (torch.distributed.get_rank(), torch.distributed.get_world_size()) == (0, 1)
        assert torch.distributed.get_backend() == "gloo"
    finally:
        torch.distributed.destroy_process_group()


@given(st.integers(1, 40), st.integers(1, 6), st.booleans())
def test_shares_are_all_units_and_fractions_add_up(number: int, count: int, in_sequences: bool) -> None:
    units = torch.randperm(number)
    lengths = torch.randint(1, 9, (number,)) if in_sequences else None
    shares = [Rank(index, count).share(units, lengths) for index in range(count)]
    assert sum(fraction for _, fraction in shares) == pytest.approx(1)
    assert torch.equal(torch.cat([part for part, fraction in shares if fraction]), units)
    assert all(len(part) for part, _ in shares)
