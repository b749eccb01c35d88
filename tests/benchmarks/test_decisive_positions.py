"""Positions in which not every move keeps the outcome."""

import numpy as np
import pytest

from benchmarks.decisive_positions import EARLIEST, DecisivePositions, decisive_positions
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.policies.loading import contestant
from league.policies.policy import Policy


def script(name: str) -> Policy:
    config = LeagueConfig.from_mapping(
        {"league": "connect_four", "environment": {"entry_point": "pettingzoo.classic.connect_four_v3"}}
    )
    return next(iter(contestant(f"script:{name}", None, interface(config)).values()))[1]


@pytest.fixture(scope="module")
def positions() -> DecisivePositions:
    return decisive_positions(12, script("one_ply"))


def test_some_moves_keep_the_outcome_and_some_do_not(positions: DecisivePositions) -> None:
    legal = positions.masks != 0
    assert (positions.boards.sum(axis=(1, 2, 3)) >= EARLIEST).all()
    assert (positions.keeping <= legal).all()
    assert positions.keeping.any(axis=1).all()
    assert (positions.keeping.sum(axis=1) < legal.sum(axis=1)).all()


def test_they_are_the_same_in_each_run(positions: DecisivePositions) -> None:
    again = decisive_positions(12, script("one_ply"))
    np.testing.assert_array_equal(again.boards, positions.boards)
    np.testing.assert_array_equal(again.keeping, positions.keeping)


def test_perfect_play_keeps_each_outcome(positions: DecisivePositions) -> None:
    assert positions.kept(script("solver")).all()
    assert not positions.kept(script("random")).all()
