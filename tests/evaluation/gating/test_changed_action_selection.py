"""After a change of `play.actions`, nothing is decided or rated by games of the other kind."""

from pathlib import Path
from typing import Any

from evaluation.gating.verdicts import conclude, open_verdict
from evaluation.gating.verification import verify
from evaluation.matches.leaderboard import CountedGames, compute_leaderboard
from league.environments.building import interface
from league.registry.registry import Registry
from league.results.ledger import Ledger
from tests.support.leagues import tictactoe

GATE = {"elo0": 0, "elo1": 100, "max_blocks": 20, "nights": None, "confirmation_blocks": 0}


def register(registry: Registry, **play: Any) -> None:
    league = tictactoe.config(play={"opening_plies": 2, "num_envs": 32} | play, gate=GATE)
    registry.leagues.register(league, interface(league))


def test_an_open_verdict_becomes_void_and_ratings_start_anew(tmp_path: Path) -> None:
    registry = tictactoe.registry(tmp_path, play={"opening_plies": 2, "num_envs": 32}, gate=GATE)
    tictactoe.publish(registry, tictactoe.graph(wins=True, blocks=True))
    row = registry.leagues.get(tictactoe.LEAGUE)
    first = conclude(registry, open_verdict(registry, row, 1, "script:random"))
    assert verify(first.verdict, registry=registry).is_current
    tictactoe.publish(registry, tictactoe.graph())
    champion = registry.aliases.current(tictactoe.LEAGUE).get("champion")
    opened = open_verdict(registry, row, 2, "script:random" if champion is None else f"{tictactoe.LEAGUE}@{champion}")
    assert compute_leaderboard(registry, tictactoe.LEAGUE)

    register(registry, actions="sampled")
    assert not verify(first.verdict, registry=registry).is_current
    row = registry.leagues.get(tictactoe.LEAGUE)
    report = conclude(registry, opened)
    assert (report.outcome, report.note) == (
        "void",
        "the league plays with sampled actions now, but the test was with greedy ones",
    )
    assert compute_leaderboard(registry, tictactoe.LEAGUE) == ()
    assert CountedGames(registry, row).games == 0
    again = open_verdict(registry, row, 2, opened.champion)
    assert Ledger(registry).schedule(again.schedule).actions == "sampled"
    decided = conclude(registry, again)
    assert decided.outcome in ("promote", "reject", "inconclusive")
    assert verify(again.id, registry=registry, replays=4).replayed == 4
    assert compute_leaderboard(registry, tictactoe.LEAGUE)
    registry.close()


def test_games_before_a_change_promote_nobody(tmp_path: Path) -> None:
    registry = tictactoe.registry(tmp_path, play={"opening_plies": 2, "num_envs": 32}, gate=GATE)
    tictactoe.publish(registry, tictactoe.graph(wins=True, blocks=True))
    opened = open_verdict(registry, registry.leagues.get(tictactoe.LEAGUE), 1, "script:random")
    is_registered = False

    def change(_: object) -> None:
        nonlocal is_registered
        if not is_registered:
            register(registry, actions="sampled")
        is_registered = True

    report = conclude(registry, opened, listener=change)
    assert is_registered
    assert (report.outcome, report.note) == (
        "void",
        "the league plays with sampled actions now, but the test was with greedy ones",
    )
    assert registry.aliases.current(tictactoe.LEAGUE) == {}
    registry.close()
