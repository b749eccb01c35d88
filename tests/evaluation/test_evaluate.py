"""`evaluate`: every kind of course, from what was asked to what is reported."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation import tournament
from evaluation.budget import Budget
from evaluation.player import player
from evaluation.shows import recorded
from evaluation.standings import standings
from evaluation.tournament import evaluate
from league.config import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.errors import EnvironmentMismatch, InvalidInput
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.settings import Storage
from tests.evaluation import examples
from tests.evaluation.test_tournament import STRENGTHS


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions, each stronger than the one before."""
    opened = examples.registry(tmp_path / "home", play={"opening_plies": 2, "copies": 2})
    for strength in STRENGTHS:
        examples.publish(opened, examples.graph(**strength))
    yield opened
    opened.close()


@pytest.fixture
def team(tmp_path: Path) -> Iterator[Registry]:
    """Three agents of one team, two versions."""
    opened = Registry.open(Storage.at(tmp_path / "team"))
    config = LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 5}},
            "sides": {"team": ["agent_*"]},
            "play": {"copies": 3},
        }
    )
    opened.register(config, interface(config))
    spaces = opened.league("spread").interface.of_policy("shared")
    for seed in (1, 2):
        examples.publish(opened, examples.linear(spaces, seed), "spread")
    yield opened
    opened.close()


def in_ledger(registry: Registry, league: str = examples.LEAGUE) -> list[Match]:
    return Ledger(registry).matches(league=league)


def test_an_adaptive_tournament_is_in_the_ledger_round_by_round(registry: Registry) -> None:
    report = evaluate(examples.LEAGUE, registry=registry, schedule="adaptive", blocks=12)
    matches = in_ledger(registry)
    assert (report.kind, report.stopped_by, report.games) == ("adaptive", "schedule", 2 * 30)
    rounds = Ledger(registry).schedules(examples.LEAGUE)
    assert len(rounds) == 6
    assert all(each.id.startswith(report.schedule) and each.kind == "adaptive" for each in rounds)
    assert len({match.seed for match in matches}) == 30
    assert report.population is None, "some have not met"
    assert all(standing.rating is not None for standing in report.standings)
    assert report.standings[0].ref in {"tictactoe@3", "script:one_ply"}


def test_an_adaptive_tournament_goes_on_where_a_shorter_one_or_a_killed_one_ended(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time a few more matches, which break off in the middle of rounds; and the choice is made only once."""
    whole = evaluate(examples.LEAGUE, registry=registry, schedule="adaptive", blocks=12)
    other = examples.registry(tmp_path / "other", play={"opening_plies": 2, "copies": 2})
    for strength in STRENGTHS:
        examples.publish(other, examples.graph(**strength))
    for games in (6, 16, 30, 44):
        part = evaluate(examples.LEAGUE, registry=other, schedule="adaptive", budget=Budget(games=games))
        assert (part.stopped_by, part.games) == ("games", games)
    assert evaluate(examples.LEAGUE, registry=other, schedule="adaptive", blocks=12) == whole
    assert in_ledger(other) == in_ledger(registry)
    monkeypatch.setattr(tournament, "player", None)
    assert evaluate(examples.LEAGUE, registry=other, schedule="adaptive", blocks=12) == whole, "nothing is played again"
    other.close()


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("schedule", ["adaptive", "round_robin"])
def test_precision_ends_at_the_same_match_with_workers(registry: Registry, tmp_path: Path, schedule: Any) -> None:
    options: dict[str, Any] = {"schedule": schedule, "budget": Budget(precision=150)}
    near = evaluate(examples.LEAGUE, registry=registry, **options)
    assert near.stopped_by == "precision"
    for standing in near.standings:
        assert standing.interval is not None
        assert standing.interval[1] - standing.interval[0] <= 300
    other = examples.registry(tmp_path / "other", play={"opening_plies": 2, "copies": 5})
    for strength in STRENGTHS:
        examples.publish(other, examples.graph(**strength))
    assert evaluate(examples.LEAGUE, registry=other, workers=2, **options) == near
    other.close()


def test_in_a_gauntlet_the_others_do_not_meet(registry: Registry) -> None:
    report = evaluate(
        examples.LEAGUE,
        ["tictactoe@3"],
        registry=registry,
        schedule="gauntlet",
        against=["tictactoe@1", "script:random"],
        blocks=4,
    )
    assert {match.contestants for match in in_ledger(registry)} == {
        ("tictactoe@3", "tictactoe@1"),
        ("tictactoe@3", "script:random"),
    }
    assert (report.games, report.population) == (16, None)
    (schedule,) = Ledger(registry).schedules(examples.LEAGUE)
    assert schedule.kind == "challenge", "a night takes no notice of it"


def test_a_gauntlet_is_against_the_champion_and_the_scripts(registry: Registry) -> None:
    registry.set_alias(examples.LEAGUE, "champion", 2, expected=None, actor="me", reason="test")
    report = evaluate(examples.LEAGUE, ["tictactoe@3"], registry=registry, schedule="gauntlet", blocks=1)
    assert {standing.ref for standing in report.standings} == {
        "tictactoe@3",
        "tictactoe@2",
        "script:random",
        "script:one_ply",
    }


def test_a_round_robin_tells_shares_of_the_population(registry: Registry) -> None:
    report = evaluate(examples.LEAGUE, registry=registry, blocks=8)
    assert report.population is not None
    best = report.payoff.contestants[0]
    assert best in {"tictactoe@3", "script:one_ply"}
    assert sum(share.value for share in report.population.alpha_rank) == pytest.approx(1)
    assert report.population.nash[-1].value == 0


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"schedule": "swiss"}, InvalidInput, "'swiss'"),
        ({"against": ["tictactoe@1"]}, InvalidInput, "only a gauntlet"),
        ({"schedule": "cross_play", "budget": Budget(precision=5)}, InvalidInput, "no ratings"),
        ({"schedule": "cross_play"}, EnvironmentMismatch, r"2 side\(s\)"),
        (
            {"schedule": "gauntlet", "against": ["tictactoe@1"], "budget": Budget(precision=5)},
            InvalidInput,
            "script:random",
        ),
        ({"schedule": "gauntlet", "refs": ["tictactoe@1"], "against": ["tictactoe@1"]}, EnvironmentMismatch, "two"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    registry: Registry, options: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        evaluate(examples.LEAGUE, registry=registry, **options)
    assert in_ledger(registry) == []


def test_cross_play_mixes_versions_in_one_team(team: Registry) -> None:
    report = evaluate("spread", registry=team, schedule="cross_play", blocks=6)
    (schedule,), matches = Ledger(team).schedules("spread"), in_ledger(team, "spread")
    assert schedule.sides == ("agent_0", "agent_1", "agent_2")
    assert {match.contestants for match in matches} == {
        ("spread@1", "spread@1"),
        ("spread@1", "spread@2"),
        ("spread@2", "spread@2"),
    }
    seats = {game.sides for match in matches for game in match.games}
    assert seats == {(0, 1, 1), (1, 0, 1), (1, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)}
    table = report.cross_play
    assert table is not None
    assert (report.standings, report.payoff.score, report.scoring) == ((), (), "team")
    assert table.contestants == ("spread@1", "spread@2")
    for row in table.returns:
        for cell in row:
            assert cell is not None
            assert cell.low is not None
            assert cell.low < cell.value < (cell.high or 0) < 0
    games = [game for match in matches if match.contestants == ("spread@1", "spread@2") for game in match.games[:1]]
    seat, others = zip(*(game.returns for game in games), strict=True)
    assert table.returns[0][1] is not None
    assert table.returns[0][1].value == pytest.approx((np.mean(seat) + 2 * np.mean(others)) / 3)
    assert standings(team, "spread") == (), "who plays together says nothing of who is stronger"


def test_who_plays_with_whom_makes_a_difference(team: Registry) -> None:
    """Each of three agents is somebody else's: the moves of a mixed team are those of neither team alone."""
    evaluate("spread", registry=team, schedule="cross_play", blocks=3)
    mixed = next(match for match in in_ledger(team, "spread") if len(set(match.contestants)) == 2)
    first, second = mixed.games
    own = {
        ref: [first.actions[i::3] for i in range(3) if first.sides[i] == c] for c, ref in enumerate(mixed.contestants)
    }
    assert [len(moves) for moves in own.values()] == [1, 2]
    assert first.actions != second.actions


def test_every_game_of_cross_play_can_be_played_again(team: Registry) -> None:
    evaluate("spread", registry=team, schedule="cross_play", blocks=3)
    config = team.league("spread").config
    environment = stepping(config.environment, 1)
    matches = in_ledger(team, "spread")
    for match in matches:
        for index, game in enumerate(match.games):
            show = recorded(match.id, index, team)
            assert list(show.cast.values()) == [match.contestants[side] for side in game.sides]
            assert len(list(show.play(environment))) == 5 + 1
    schedule = Ledger(team).schedule(matches[0].schedule)
    document = config.model_dump_json(by_alias=True)
    assert player(team.storage, document).play(schedule, range(schedule.length)) == matches
