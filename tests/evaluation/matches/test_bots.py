"""Bots as contestants in matches."""

from collections.abc import Sequence

import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.schedules.builders import round_robin
from league.environments.building import interface
from league.environments.lockstep import stock_stepping
from league.policies.loading import contestant
from league.results.records import Match
from tests.support.leagues import tictactoe
from tests.support.policies.bots import MODULE

CONFIG = tictactoe.config(play={"opening_plies": 2})
INTERFACE = interface(CONFIG)
EXAMPLE = "script:examples.tictactoe_bot:act"


def play(contestants: Sequence[str], num_envs: int, blocks: int = 10) -> list[Match]:
    schedule = round_robin(CONFIG, INTERFACE, contestants, blocks)
    roster = {ref: contestant(ref, None, INTERFACE) for ref in contestants}
    environment = stock_stepping(CONFIG.environment, num_envs)
    return play_matches(schedule, range(schedule.length), environment, INTERFACE, roster)


@pytest.mark.parametrize("name", ["Alternating", "sampled", "Failing", "all_at_once"])
def test_games_do_not_depend_on_the_number_of_environments(name: str) -> None:
    contestants = ["script:random", f"script:{MODULE}:{name}"]
    assert play(contestants, num_envs=1) == play(contestants, num_envs=16)


def test_an_exception_forfeits_the_game_in_which_it_occurs() -> None:
    games = [game for match in play(["script:random", f"script:{MODULE}:Failing"], 8) for game in match.games]
    forfeits = [forfeit for game in games for forfeit in game.forfeits]
    assert 0 < len(forfeits) < len(games)
    assert {(forfeit.contestant, forfeit.reason) for forfeit in forfeits} == {(1, "crashed")}


def test_a_wrong_return_value_forfeits_the_game() -> None:
    for match in play(["script:random", f"script:{MODULE}:text"], 4, blocks=2):
        for game in match.games:
            assert [(each.contestant, each.reason) for each in game.forfeits] == [(1, "malformed")]


def test_the_example_beats_random_play() -> None:
    scores = [match.score(1) for match in play(["script:random", EXAMPLE], 8)]
    assert sum(scores) / len(scores) > 0.8
