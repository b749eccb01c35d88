"""Bots as contestants in matches."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.matches.game_records import forfeits_of_all
from evaluation.matches.policy_calls import fault_of
from evaluation.schedules.builders import round_robin
from league.environments.building import interface
from league.environments.lockstep import stock_stepping
from league.policies.loading import contestant
from league.results.records import MAX_DETAIL, Match, dump_games, load_games
from tests.support.leagues import tictactoe
from tests.support.policies import bots
from tests.support.policies.bots import MODULE

CONFIG = tictactoe.config(play={"opening_plies": 2})
INTERFACE = interface(CONFIG)
EXAMPLE = "script:policy_league.examples.tictactoe_bot:act"


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


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("Failing", r"by an exception \(the first: RuntimeError: no idea at bots.py, line {RuntimeError}\)"),
        ("Leaving", r"by an exception \(the first: ExitCalled: sys.exit\('bye'\) .* at bots.py, line {sys.exit}\)"),
        ("failing_at_once", r"by an exception \(the first: ValueError: cannot reshape .* at bots.py, line {reshape}\)"),
        ("taken", r"by an illegal action \(the first: action (\d), legal: (?!.*\1.*\))[\d, ]*\)"),
        ("text", r"by an output that is no action \(the first: the bot returned str 'left': expected int64 \[\]\)"),
    ],
)
def test_forfeits_are_reported_with_the_first_fault(name: str, sentence: str) -> None:
    """An exception with the line of the bot that raised it, an action with those that were legal."""
    lines = Path(bots.__file__).read_text().splitlines()
    words = ("RuntimeError", "sys.exit", "reshape")
    places = {word: str(1 + next(i for i, line in enumerate(lines) if word in line)) for word in words}
    for word, line in places.items():
        sentence = sentence.replace(f"{{{word}}}", line)
    bot = f"script:{MODULE}:{name}"
    matches = [replace(match, games=load_games(dump_games(match.games))) for match in play(["script:random", bot], 8)]
    lost = forfeits_of_all(matches)
    assert lost.keys() == {bot}
    assert re.fullmatch(rf"{lost[bot].games} games: {lost[bot].games} {sentence}", str(lost[bot]))
    assert lost[bot].games == sum(bool(game.forfeits) for match in matches for game in match.games) > 0


def test_a_long_message_of_a_bot_is_cut() -> None:
    fault = fault_of(ValueError("x" * 10_000))
    assert len(fault.detail) == MAX_DETAIL


def test_a_wrong_return_value_forfeits_the_game() -> None:
    for match in play(["script:random", f"script:{MODULE}:text"], 4, blocks=2):
        for game in match.games:
            assert [(each.contestant, each.reason) for each in game.forfeits] == [(1, "malformed")]


def test_the_example_beats_random_play() -> None:
    scores = [match.score(1) for match in play(["script:random", EXAMPLE], 8)]
    assert sum(scores) / len(scores) > 0.8
