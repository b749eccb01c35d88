"""Mixtures in matches: one member plays each game, is drawn from the game's seed, and recorded."""

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.matches.game_loop import play_matches
from evaluation.matches.seating import acting_versions
from evaluation.matches.tournament import evaluate, play_schedule
from evaluation.playback.replay import live_game, recorded_game
from evaluation.schedules.builders import game_plans, round_robin
from league.environments.lockstep import stock_stepping
from league.errors import InvalidInput
from league.policies.loading import contestant
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import Member, Mixture
from league.results.ledger import Ledger
from league.results.records import Game, dump_games, load_games
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.leagues import tictactoe
from tests.support.leagues.tournaments import STRENGTHS

MIXTURE = "tictactoe@3"


def mixture(share: float) -> Mixture:
    shares = {1: share, 2: 1 - share}
    return Mixture(members=tuple(Member(version=n, probability=p, sha256="0" * 64) for n, p in shares.items()))


@given(st.floats(0.05, 0.95), st.integers(0, 2**40), st.integers(0, 50))
@settings(max_examples=30, deadline=None)
def test_a_draw_depends_on_the_game_only(share: float, seed: int, position: int) -> None:
    schedule = replace(round_robin(tictactoe.config(), INTERFACE, [MIXTURE, *CONTESTANTS[2:]], 100), seed=seed)
    mixtures = {MIXTURE: mixture(share)}
    positions = [position, position + 7, position + 20]
    together = acting_versions(schedule, game_plans(schedule, positions), mixtures)
    alone = [acting_versions(schedule, game_plans(schedule, [each]), mixtures).members for each in positions]
    assert together.members == tuple(members for two in alone for members in two)
    for plan, members in zip(game_plans(schedule, positions).contestants, together.members, strict=True):
        assert [member is not None for member in members] == [index == 0 for index in plan] or members == ()


def test_members_play_their_shares() -> None:
    schedule = round_robin(tictactoe.config(), INTERFACE, [MIXTURE, "script:random"], 1000)
    drawn = acting_versions(schedule, game_plans(schedule, range(1000)), {MIXTURE: mixture(0.3)})
    found = Counter(members[0] for members in drawn.members)
    assert 500 < found[1] < 700
    assert found[1] + found[2] == 2000


def test_the_member_plays_as_it_does_alone() -> None:
    """Every recorded game equals the game of the member that was drawn."""
    mixed = round_robin(tictactoe.config(), INTERFACE, [MIXTURE, "script:one_ply"], 12)
    roster = build_roster()
    matches = play_matches(
        mixed,
        range(12),
        stock_stepping(CONFIG.environment, 5),
        INTERFACE,
        roster,
        mixtures={MIXTURE: mixture(0.5)},
    )
    alone = {}
    for number in (1, 2):
        schedule = replace(mixed, contestants=(f"tictactoe@{number}", "script:one_ply"))
        alone[number] = play_matches(schedule, range(12), stock_stepping(CONFIG.environment, 5), INTERFACE, roster)
    played = [(match.position, index, game) for match in matches for index, game in enumerate(match.games)]
    assert {game.members[0] for *_, game in played} == {1, 2}
    for position, index, game in played:
        member = game.members[0]
        assert member is not None
        assert matches[position].acting(index) == (f"tictactoe@{member}", "script:one_ply")
        expected = alone[member][position].games[index]
        assert (game.actions, game.opening, game.returns) == (expected.actions, expected.opening, expected.returns)


def test_members_are_part_of_the_record() -> None:
    game = Game((0, 1), 7, (), (1, 2), (1.0, -1.0), (1.0, 0.0), members=(5, None))
    plain = replace(game, members=())
    assert load_games(dump_games([game, plain])) == (game, plain)
    assert "members" not in dump_games([plain])


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions, and a mixture of two as its champion."""
    with closing(tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 2})) as opened:
        for strength in STRENGTHS:
            tictactoe.publish(opened, tictactoe.graph(**strength))
        number = opened.publisher.publish_mixture(tictactoe.LEAGUE, {1: 0.5, 3: 0.5}).number
        opened.aliases.set(tictactoe.LEAGUE, "champion", number, expected=ANY, actor="me", reason="test")
        yield opened


def test_a_mixture_is_one_contestant_and_its_games_are_replayed(registry: Registry) -> None:
    report = evaluate(
        tictactoe.LEAGUE, ["tictactoe@champion", "tictactoe@2"], registry=registry, schedule="gauntlet", blocks=4
    )
    assert "tictactoe@4" in [standing.ref for standing in report.leaderboard]
    matches = [m for m in Ledger(registry).matches(league=tictactoe.LEAGUE) if m.contestants[0] == "tictactoe@4"]
    assert {game.members[0] for match in matches for game in match.games} == {1, 3}
    for match in matches[:3]:
        source = recorded_game(match.id, 1, registry, chances=True)
        assert set(source.controllers.values()) == set(match.acting(1))
        with closing(stock_stepping(source.config.environment, 1)) as environment:
            *_, last = source.play(environment)
        assert last.is_over
    schedule = Ledger(registry).schedule(matches[0].schedule)
    assert play_schedule(schedule, registry=registry) == Ledger(registry).matches(
        league=tictactoe.LEAGUE, schedule=schedule.id
    )


def test_a_live_game_is_played_by_one_member(registry: Registry) -> None:
    found = {live_game(["tictactoe@champion"], registry, seed=seed).controllers["player_1"] for seed in range(20)}
    assert found == {"tictactoe@1", "tictactoe@3"}


def test_a_mixture_has_no_policies_of_its_own(registry: Registry) -> None:
    with pytest.raises(
        InvalidInput, match=r"tictactoe@4 is a mixture \(@1 50.0 %, @3 50.0 %\): name one of its members"
    ):
        contestant("tictactoe@4", registry, INTERFACE)
