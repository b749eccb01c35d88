"""`evaluate` for each kind of schedule, from the request to the report."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.matches import tournament
from evaluation.matches.leaderboard import compute_leaderboard
from evaluation.matches.tournament import evaluate
from evaluation.matches.worker import match_worker
from evaluation.playback.replay import recorded_game
from evaluation.schedules.tournament_plan import Budget
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stock_stepping
from league.errors import EnvironmentMismatch, InvalidInput
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.records import Match
from league.settings import Storage
from tests.support.leagues import tictactoe
from tests.support.leagues.tournaments import STRENGTHS


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions of increasing strength."""
    opened = tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 2})
    for strength in STRENGTHS:
        tictactoe.publish(opened, tictactoe.graph(**strength))
    yield opened
    opened.close()


@pytest.fixture
def team(tmp_path: Path) -> Iterator[Registry]:
    """A team of three agents, with two versions."""
    opened = Registry.open(Storage.at(tmp_path / "team"))
    config = LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 5}},
            "sides": {"team": ["agent_*"]},
            "play": {"num_envs": 3},
        }
    )
    opened.leagues.register(config, interface(config))
    spaces = opened.leagues.get("spread").interface.of_policy("shared")
    for seed in (1, 2):
        tictactoe.publish(opened, tictactoe.linear(spaces, seed), "spread")
    yield opened
    opened.close()


def in_ledger(registry: Registry, league: str = tictactoe.LEAGUE) -> list[Match]:
    return Ledger(registry).matches(league=league)


def test_an_adaptive_tournament_is_stored_round_by_round(registry: Registry) -> None:
    report = evaluate(tictactoe.LEAGUE, registry=registry, schedule="adaptive", blocks=12)
    matches = in_ledger(registry)
    assert (report.kind, report.stopped_by, report.games) == ("adaptive", "schedule", 2 * 30)
    rounds = Ledger(registry).schedules(tictactoe.LEAGUE)
    assert len(rounds) == 6
    assert all(each.id.startswith(report.schedule) and each.kind == "adaptive" for each in rounds)
    assert len({match.seed for match in matches}) == 30
    assert report.population is None, "some pairs have not played"
    assert all(standing.rating is not None for standing in report.leaderboard)
    assert report.leaderboard[0].ref in {"tictactoe@3", "script:one_ply"}


def test_an_adaptive_tournament_continues_a_shorter_or_killed_one(
    registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each time with a few more matches, stopping within rounds; pairs are chosen only once."""
    complete = evaluate(tictactoe.LEAGUE, registry=registry, schedule="adaptive", blocks=12)
    other = tictactoe.registry(tmp_path / "other", play={"opening_plies": 2, "num_envs": 2})
    for strength in STRENGTHS:
        tictactoe.publish(other, tictactoe.graph(**strength))
    for games in (6, 16, 30, 44):
        part = evaluate(tictactoe.LEAGUE, registry=other, schedule="adaptive", budget=Budget(games=games))
        assert (part.stopped_by, part.games) == ("games", games)
    assert evaluate(tictactoe.LEAGUE, registry=other, schedule="adaptive", blocks=12) == complete
    assert in_ledger(other) == in_ledger(registry)
    monkeypatch.setattr(tournament, "match_worker", None)
    assert evaluate(tictactoe.LEAGUE, registry=other, schedule="adaptive", blocks=12) == complete, (
        "no match is repeated"
    )
    other.close()


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("schedule", [pytest.param("adaptive", marks=pytest.mark.slow), "round_robin"])
def test_precision_stops_at_the_same_match_with_workers(registry: Registry, tmp_path: Path, schedule: Any) -> None:
    options: dict[str, Any] = {"schedule": schedule, "budget": Budget(precision=150)}
    report = evaluate(tictactoe.LEAGUE, registry=registry, **options)
    assert report.stopped_by == "precision"
    for standing in report.leaderboard:
        assert standing.interval is not None
        assert standing.interval[1] - standing.interval[0] <= 300
    other = tictactoe.registry(tmp_path / "other", play={"opening_plies": 2, "num_envs": 5})
    for strength in STRENGTHS:
        tictactoe.publish(other, tictactoe.graph(**strength))
    assert evaluate(tictactoe.LEAGUE, registry=other, workers=2, **options) == report
    other.close()


def test_in_a_gauntlet_the_opponents_do_not_meet(registry: Registry) -> None:
    report = evaluate(
        tictactoe.LEAGUE,
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
    (schedule,) = Ledger(registry).schedules(tictactoe.LEAGUE)
    assert schedule.kind == "challenge", "nightly runs ignore it"


def test_a_gauntlet_is_against_the_champion_and_the_scripts(registry: Registry) -> None:
    registry.aliases.set(tictactoe.LEAGUE, "champion", 2, expected=None, actor="me", reason="test")
    report = evaluate(tictactoe.LEAGUE, ["tictactoe@3"], registry=registry, schedule="gauntlet", blocks=1)
    assert {standing.ref for standing in report.leaderboard} == {
        "tictactoe@3",
        "tictactoe@2",
        "script:random",
        "script:one_ply",
    }


def test_a_round_robin_reports_population_shares(registry: Registry) -> None:
    report = evaluate(tictactoe.LEAGUE, registry=registry, blocks=8)
    assert report.population is not None
    best = report.payoff.contestants[0]
    assert best in {"tictactoe@3", "script:one_ply"}
    assert sum(share.value for share in report.population.alpha_rank) == pytest.approx(1)
    assert report.population.nash[-1].value == 0


@pytest.mark.parametrize(
    ("options", "error", "message"),
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
def test_incompatible_options_are_rejected(
    registry: Registry, options: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        evaluate(tictactoe.LEAGUE, registry=registry, **options)
    assert in_ledger(registry) == []


def test_cross_play_mixes_versions_in_a_team(team: Registry) -> None:
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
    assert (report.leaderboard, report.payoff.score, report.scoring) == ((), (), "team")
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
    assert compute_leaderboard(team, "spread") == (), "team games have no leaderboard"


def test_teammates_affect_the_game(team: Registry) -> None:
    """Each agent may be of another version: the moves of a mixed team differ from those of both pure teams."""
    evaluate("spread", registry=team, schedule="cross_play", blocks=3)
    mixed = next(match for match in in_ledger(team, "spread") if len(set(match.contestants)) == 2)
    first, second = mixed.games
    own = {
        ref: [first.actions[i::3] for i in range(3) if first.sides[i] == c] for c, ref in enumerate(mixed.contestants)
    }
    assert [len(moves) for moves in own.values()] == [1, 2]
    assert first.actions != second.actions


def test_each_cross_play_game_can_be_replayed(team: Registry) -> None:
    evaluate("spread", registry=team, schedule="cross_play", blocks=3)
    config = team.leagues.get("spread").config
    environment = stock_stepping(config.environment, 1)
    matches = in_ledger(team, "spread")
    for match in matches:
        for index, game in enumerate(match.games):
            source = recorded_game(match.id, index, team)
            assert list(source.controllers.values()) == [match.contestants[side] for side in game.sides]
            assert len(list(source.play(environment))) == 5 + 1
    schedule = Ledger(team).schedule(matches[0].schedule)
    document = config.model_dump_json(by_alias=True)
    assert match_worker(team.storage, document).play(schedule, range(schedule.length)) == matches
