from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from evaluation.matches.game_loop import play_matches
from evaluation.playback.replay import replay
from evaluation.schedules.builders import round_robin
from league.environments.lockstep import stock_stepping
from league.errors import EnvironmentMismatch, GameHung
from league.random.seeds import generator
from league.results.records import Match, Schedule
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, WINNER, build_roster
from tests.support.leagues import tictactoe


def schedule(blocks: int = 4, plies: int = 2, contestants: Sequence[str] = CONTESTANTS) -> Schedule:
    league = tictactoe.config(play={"opening_plies": plies})
    return round_robin(league, INTERFACE, contestants, blocks)


def play(schedule: Schedule, num_envs: int = 8, positions: Sequence[int] | None = None) -> list[Match]:
    environment = stock_stepping(CONFIG.environment, num_envs)
    return play_matches(
        schedule, range(schedule.length) if positions is None else positions, environment, INTERFACE, build_roster()
    )


@pytest.mark.parametrize("num_envs", [7, 32, 100])
def test_games_do_not_depend_on_the_number_of_environments(num_envs: int) -> None:
    assert play(schedule(), num_envs) == play(schedule(), 1)


def test_games_do_not_depend_on_other_games() -> None:
    together = play(schedule())
    assert [play(schedule(), positions=[position])[0] for position in range(schedule().length)] == together


def test_matches_are_returned_in_the_requested_order() -> None:
    assert [match.position for match in play(schedule(), positions=[5, 0, 3])] == [5, 0, 3]


def test_a_block_shares_its_opening_and_exchanges_the_sides() -> None:
    for match in play(schedule()):
        first, second = match.games
        assert first.opening == second.opening
        assert len(first.opening) == 2
        assert (first.sides, second.sides) == ((0, 1), (1, 0))
        assert first.seed == second.seed == match.seed


def test_openings_differ_between_blocks() -> None:
    openings = {match.games[0].opening for match in play(schedule(blocks=40, contestants=CONTESTANTS[:2]))}
    assert len(openings) > 20


def test_openings_that_end_the_game_are_redrawn() -> None:
    """Six random moves sometimes end a game of tic-tac-toe; each recorded game continues after its opening."""
    matches = play(schedule(blocks=40, plies=6, contestants=CONTESTANTS[:2]))
    assert len(matches) == 40
    for match in matches:
        for game in match.games:
            assert len(game.opening) == 6
            assert game.actions
            assert sum(game.scores) == 1


def test_openings_that_always_end_the_game_are_rejected() -> None:
    with pytest.raises(EnvironmentMismatch, match="opening_plies"):
        play(schedule(plies=9), positions=[0])


def test_without_openings_greedy_policies_repeat_their_games() -> None:
    matches = play(schedule(blocks=5, plies=0, contestants=CONTESTANTS[:2]))
    assert len({game.actions for match in matches for game in match.games}) == 2
    assert all(game.opening == () for match in matches for game in match.games)


def test_returns_belong_to_contestants_on_each_side() -> None:
    """A script that wins whenever it can scores more than one that does not, on both sides."""
    matches = play(schedule(blocks=60, contestants=[WINNER, "script:random"]))
    for side in (0, 1):
        points = [game.scores[0] for match in matches for game in match.games if game.sides[side] == 0]
        assert np.mean(points) > 0.7
    assert all(set(game.returns) in ({1.0, -1.0}, {0.0}) for match in matches for game in match.games)


def test_recorded_games_replay() -> None:
    for match in play(schedule()):
        for index, game in enumerate(match.games):
            steps = list(replay(stock_stepping(CONFIG.environment, 1), CONFIG, INTERFACE, match, index))
            assert [move.action for m in steps for move in m.moves] == [*game.opening, *game.actions]


@pytest.mark.parametrize("change", ["returns", "shorter", "longer", "illegal", "environment"])
def test_a_record_that_cannot_be_replayed_is_rejected(change: str) -> None:
    match = play(schedule(), positions=[0])[0]
    game = match.games[0]
    forged = {
        "returns": replace(game, returns=(0.5, 0.5)),
        "shorter": replace(game, actions=game.actions[:-1]),
        "longer": replace(game, actions=(*game.actions, 0)),
        "illegal": replace(game, actions=(game.opening[0], *game.actions[1:])),
        "environment": game,
    }[change]
    digest = "another" if change == "environment" else match.environment_digest
    record = replace(match, games=(forged, match.games[1]), environment_digest=digest)
    with pytest.raises(EnvironmentMismatch):
        list(replay(stock_stepping(CONFIG.environment, 1), CONFIG, INTERFACE, record, 0))


def test_a_game_that_does_not_end_is_reported() -> None:
    with pytest.raises(GameHung, match="script:random"):
        play_matches(
            schedule(contestants=["script:random", "script:one_ply"]),
            [0],
            stock_stepping(CONFIG.environment, 2),
            INTERFACE,
            build_roster(),
            max_moves=4,
        )


def test_openings_and_scripts_draw_from_the_generators_of_their_game() -> None:
    """These draws are part of recorded games and must never change."""
    for match in play(schedule(contestants=["script:random", "tictactoe@1"])):
        for index, game in enumerate(match.games):
            squares = list(range(9))
            openings = [generator(match.seed, "opening", 0, agent) for agent in (0, 1)]
            assert game.opening == tuple(squares.pop(int(len(squares) * each.random())) for each in openings)
            agent = game.sides.index(0)
            script = generator(match.seed, "policy", index, agent)
            for ply, action in enumerate(game.actions):
                if ply % 2 == agent:
                    assert action == squares[int(len(squares) * script.random())]
                squares.remove(action)
