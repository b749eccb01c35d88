"""Matches in each kind of environment: simultaneous, with any number of sides, continuous, recurrent."""

from dataclasses import replace

import numpy as np
import pytest

from evaluation.playback.replay import replay
from evaluation.playback.single_game import play_game
from league.environments.lockstep import stock_stepping
from league.errors import GameHung
from league.results.records import Scoring, dump_games, load_games
from league.results.scoring import admit
from tests.support.environments.kinds import KINDS, Kind

kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
CONTESTANTS = ["kind@1", "kind@2", "script:random"]


@kinds
def test_games_do_not_depend_on_the_number_of_environments(kind: Kind) -> None:
    schedule = kind.schedule(CONTESTANTS)
    sequential = kind.play(schedule, num_envs=1)
    assert [match.position for match in sequential] == list(range(9))
    for num_envs in (4, 32):
        assert kind.play(schedule, num_envs) == sequential


@kinds
def test_recorded_games_are_accepted_stored_and_replayed_exactly(kind: Kind) -> None:
    schedule = kind.schedule(CONTESTANTS)
    environment = stock_stepping(kind.config.environment, 1)
    for match in kind.play(schedule):
        admit(match, schedule)
        stored = replace(match, games=load_games(dump_games(match.games)))
        assert stored == match
        for index, game in enumerate(stored.games):
            steps = list(replay(environment, kind.config, kind.interface, stored, index))
            assert [move.action for step in steps for move in step.moves] == [*game.opening, *game.actions]


@kinds
def test_a_match_equals_the_shown_game(kind: Kind) -> None:
    """A shown game calls the policy of each agent separately, and carries its state itself."""
    schedule = kind.schedule(["kind@1", "kind@2"], plies=0)
    environment = stock_stepping(kind.config.environment, 1)
    side = {agent: i for i, agents in enumerate(kind.interface.sides.values()) for agent in agents}
    for match in kind.play(schedule):
        for game in match.games:
            seats = {agent: match.contestants[game.sides[side[agent]]] for agent in kind.interface.agents}
            players = {agent: kind.roster[ref][agent][1] for agent, ref in seats.items()}
            steps = list(play_game(environment, players, game.seed))
            assert tuple(move.action for step in steps for move in step.moves) == game.actions


@kinds
def test_an_identical_policy_scores_even_in_each_block(kind: Kind) -> None:
    for match in kind.play(kind.schedule(["kind@1", "kind@3"], blocks=6)):
        assert match.score(0) == match.score(1) == 0.5
        assert match.mean_return(0) == pytest.approx(match.mean_return(1), abs=1e-12)


@kinds
def test_exchanging_the_contestants_exchanges_the_results(kind: Kind) -> None:
    forward, backward = (kind.schedule(pair, blocks=6) for pair in (["kind@1", "kind@2"], ["kind@2", "kind@1"]))
    backward = replace(backward, id=forward.id, seed=forward.seed)
    scores = [match.score(0) for match in kind.play(forward)]
    assert [match.score(1) for match in kind.play(backward)] == scores


@pytest.mark.slow
@pytest.mark.parametrize("scoring", ["game", "side"])
def test_random_policies_score_even_on_unequal_sides(scoring: Scoring) -> None:
    """Four sides, three hunters and one hunted: the side decides a game, but not the mean of blocks."""
    roles = {"hunters": ["adversary_*"], "hunted": ["agent_*"]}
    kind = Kind("mpe2.simple_tag_v3", {}, None, roles)
    schedule = replace(kind.schedule(["script:random", "script:again"], blocks=160, plies=0), scoring=scoring)
    matches = kind.play(schedule, num_envs=16)
    scores = np.array([match.score(0) for match in matches])
    assert abs(scores.mean() - 0.5) < 4 * scores.std() / np.sqrt(len(scores))
    by_seat = [np.mean([match.games[0].scores[0] for match in matches[seat::4]]) for seat in range(4)]
    if scoring == "game":
        assert max(by_seat) - min(by_seat) > 0.2
        assert {tuple(sorted(set(game.sides))) for match in matches for game in match.games} == {(0, 1)}


def test_with_one_side_each_contestant_plays_alone() -> None:
    kind = KINDS["team"]
    for match in kind.play(kind.schedule(["kind@1", "kind@2"])):
        first, second = match.games
        assert (first.sides, second.sides) == ((0,), (1,))
        assert first.returns[1] is second.returns[0] is None
        assert first.opening == second.opening
        assert first.actions != second.actions


def test_an_opening_consists_of_random_steps_of_all_agents() -> None:
    kind = KINDS["free for all"]
    matches = kind.play(kind.schedule(["kind@1", "kind@2"], blocks=6, plies=2))
    assert {len(game.opening) for match in matches for game in match.games} == {2 * 3}
    assert {len(game.actions) for match in matches for game in match.games} == {4 * 3}
    openings = [{game.opening for game in match.games} for match in matches]
    assert all(len(opening) == 1 for opening in openings)
    assert len(set.union(*openings)) == len(matches)


def test_a_step_of_many_agents_is_one_move() -> None:
    kind = KINDS["free for all"]
    schedule = kind.schedule(["kind@1", "kind@2"])
    assert kind.play(schedule, max_moves=6)
    with pytest.raises(GameHung, match="after 5 moves"):
        kind.play(schedule, max_moves=5)
