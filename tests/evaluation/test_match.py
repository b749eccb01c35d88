import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.match import plan, scores
from evaluation.schedule import round_robin
from league.environments.building import interface
from tests.evaluation.examples import config

SCHEDULE = round_robin(config(), interface(config()), ["tictactoe@1", "tictactoe@2", "script:random"], 10)


@given(st.integers(0, SCHEDULE.length - 1))
def test_everybody_plays_every_side_once_from_one_seed(position: int) -> None:
    games = plan(SCHEDULE, position)
    assert [game.sides for game in games] == [(0, 1), (1, 0)]
    assert {game.seed for game in games} == {SCHEDULE.seed_at(position)}
    assert {game.contestants for game in games} == {SCHEDULE.contestants_at(position)}


def test_openings_are_the_blocks_and_draws_of_policies_the_games_own() -> None:
    first, second = plan(SCHEDULE, 0)
    assert first.opening(0).random() == second.opening(0).random()
    streams = [game.policy(side) for game in (first, second) for side in (0, 1)]
    draws = {stream.random() for stream in [*streams, first.opening(0), first.opening(1)]}
    assert len(draws) == 6


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        ((1.0, -1.0), (1.0, 0.0)),
        ((0.0, 0.0), (0.5, 0.5)),
        ((3.0, 5.0), (0.0, 1.0)),
        ((1.0, 2.0, 3.0), (0.0, 0.5, 1.0)),
        ((1.0, 1.0, 0.0), (0.75, 0.75, 0.0)),
    ],
)
def test_scores_go_by_returns(returns: tuple[float, ...], expected: tuple[float, ...]) -> None:
    assert scores(returns) == expected
