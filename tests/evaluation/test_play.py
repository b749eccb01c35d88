from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from evaluation.play import Roster, play
from evaluation.replay import replay
from evaluation.schedule import round_robin
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.errors import EnvironmentMismatch, GameHung
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.policies.scripted import script
from league.results.records import Match, Schedule
from tests.evaluation import examples

CONFIG = examples.config()
INTERFACE = interface(CONFIG)
GREEDY, WINNER = "tictactoe@1", "tictactoe@2"
CONTESTANTS = [GREEDY, WINNER, "script:random", "script:one_ply"]


def roster() -> Roster:
    spaces = INTERFACE.of_policy("shared")
    policies: dict[str, Policy] = {
        GREEDY: OnnxPolicy(examples.graph()),
        WINNER: OnnxPolicy(examples.graph(wins=True, blocks=True)),
        "script:random": script("random", spaces.observation, spaces.action),
        "script:one_ply": script("one_ply", spaces.observation, spaces.action),
    }
    return {ref: dict.fromkeys(INTERFACE.agents, ("shared", policy)) for ref, policy in policies.items()}


def schedule(blocks: int = 4, plies: int = 2, contestants: Sequence[str] = CONTESTANTS) -> Schedule:
    league = examples.config(play={"opening_plies": plies})
    return round_robin(league, INTERFACE, contestants, blocks)


def played(schedule: Schedule, copies: int = 8, positions: Sequence[int] | None = None) -> list[Match]:
    environment = stepping(CONFIG.environment, copies)
    return play(schedule, range(schedule.length) if positions is None else positions, environment, INTERFACE, roster())


@pytest.mark.parametrize("copies", [7, 32, 100])
def test_games_do_not_depend_on_how_many_are_played_together(copies: int) -> None:
    assert played(schedule(), copies) == played(schedule(), 1)


def test_games_do_not_depend_on_their_company() -> None:
    together = played(schedule())
    assert [played(schedule(), positions=[position])[0] for position in range(schedule().length)] == together


def test_matches_come_in_the_order_asked_for() -> None:
    assert [match.position for match in played(schedule(), positions=[5, 0, 3])] == [5, 0, 3]


def test_a_block_shares_its_opening_and_rotates_its_sides() -> None:
    for match in played(schedule()):
        first, second = match.games
        assert first.opening == second.opening
        assert len(first.opening) == 2
        assert (first.sides, second.sides) == ((0, 1), (1, 0))
        assert first.seed == second.seed == match.seed


def test_openings_differ_between_blocks() -> None:
    openings = {match.games[0].opening for match in played(schedule(blocks=40, contestants=CONTESTANTS[:2]))}
    assert len(openings) > 20


def test_openings_that_end_the_game_are_drawn_again() -> None:
    """Six random moves end a game of tic-tac-toe now and then; every recorded game goes on behind its opening."""
    matches = played(schedule(blocks=40, plies=6, contestants=CONTESTANTS[:2]))
    assert len(matches) == 40
    for match in matches:
        for game in match.games:
            assert len(game.opening) == 6
            assert game.actions
            assert sum(game.scores) == 1


def test_openings_that_always_end_the_game_are_a_fault() -> None:
    with pytest.raises(EnvironmentMismatch, match="opening_plies"):
        played(schedule(plies=9), positions=[0])


def test_without_openings_greedy_policies_repeat_themselves() -> None:
    matches = played(schedule(blocks=5, plies=0, contestants=CONTESTANTS[:2]))
    assert len({game.actions for match in matches for game in match.games}) == 2
    assert all(game.opening == () for match in matches for game in match.games)


def test_returns_belong_to_contestants_whatever_their_side() -> None:
    """A script that wins whenever it can scores over one that never does, on both sides."""
    matches = played(schedule(blocks=60, contestants=[WINNER, "script:random"]))
    for side in (0, 1):
        points = [game.scores[0] for match in matches for game in match.games if game.sides[side] == 0]
        assert np.mean(points) > 0.7
    assert all(set(game.returns) in ({1.0, -1.0}, {0.0}) for match in matches for game in match.games)


def test_recorded_games_replay() -> None:
    for match in played(schedule()):
        for index, game in enumerate(match.games):
            moments = list(replay(stepping(CONFIG.environment, 1), CONFIG, INTERFACE, match, index))
            assert [move.action for m in moments for move in m.moves] == [*game.opening, *game.actions]


@pytest.mark.parametrize("change", ["returns", "shorter", "longer", "illegal", "environment"])
def test_a_record_that_does_not_replay_is_refused(change: str) -> None:
    match = played(schedule(), positions=[0])[0]
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
        list(replay(stepping(CONFIG.environment, 1), CONFIG, INTERFACE, record, 0))


def test_a_game_that_does_not_end_is_a_fault() -> None:
    with pytest.raises(GameHung, match="script:random"):
        play(
            schedule(contestants=["script:random", "script:one_ply"]),
            [0],
            stepping(CONFIG.environment, 2),
            INTERFACE,
            roster(),
            max_moves=4,
        )
