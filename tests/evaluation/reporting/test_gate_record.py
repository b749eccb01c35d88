"""Why the best version is not the champion, and doubts before a promotion by hand."""

from pathlib import Path

import pytest

from evaluation.documents import Standing
from evaluation.gating.verdicts import open_verdict, void
from evaluation.matches.tournament import evaluate
from evaluation.reporting.gate_record import doubts, why_not_champion
from league.registry.registry import Registry
from tests.support.leagues import tictactoe
from tests.support.leagues.judged_league import CONFIG, MIDDLING, STRONG, WEAK, league_of
from tests.support.leagues.tictactoe import LEAGUE


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Version 1 is the champion."""
    opened = league_of(tmp_path, WEAK, MIDDLING, STRONG)
    promote(opened, 1)
    return opened


def promote(registry: Registry, version: int) -> None:
    now = registry.aliases.current(LEAGUE).get("champion")
    registry.aliases.set(LEAGUE, "champion", version, expected=now, actor="ada", reason="by hand")


def standing(ref: str, rating: float | None, half: float = 10.0) -> Standing:
    interval = None if rating is None else (rating - half, rating + half)
    return Standing(ref, None, 0.5, 100, None, rating, interval)


BEST = (standing("script:minimax_2", 300), standing("tictactoe@3", 200), standing("tictactoe@1", 100))


def closed(registry: Registry, candidate: int, outcome: str, **evidence: object) -> str:
    verdict = open_verdict(registry, registry.leagues.get(LEAGUE), candidate, "tictactoe@1")
    registry.verdicts.close(verdict.id, outcome, evidence)
    return verdict.short_id


def test_nothing_is_explained_if_the_champion_is_best_or_nothing_is_rated(registry: Registry) -> None:
    assert why_not_champion(registry, LEAGUE, BEST[2:]) is None
    assert why_not_champion(registry, LEAGUE, ()) is None
    assert why_not_champion(registry, LEAGUE, (BEST[0], BEST[2], BEST[1])) is None, "a script cannot be champion"
    assert why_not_champion(registry, LEAGUE, (standing("tictactoe@3", None), BEST[2])) is None


def test_a_version_that_was_not_tested(registry: Registry) -> None:
    assert why_not_champion(registry, LEAGUE, BEST) == (
        "tictactoe@3 is the best version by rating, but the champion is tictactoe@1: it has not been tested:"
        " `league nightly tictactoe` tests it."
    )
    wide = (standing("tictactoe@3", 200, 80), standing("tictactoe@1", 100, 80))
    assert str(why_not_champion(registry, LEAGUE, wide)).endswith("; their 95 % intervals overlap.")
    unrated = (BEST[1], standing("tictactoe@1", None))
    assert "the champion is not rated under the current conditions" in str(why_not_champion(registry, LEAGUE, unrated))


def test_a_version_that_the_gate_did_not_promote(registry: Registry) -> None:
    verdict = open_verdict(registry, registry.leagues.get(LEAGUE), 3, "tictactoe@1")
    assert f"verdict {verdict.short_id} on it is open" in str(why_not_champion(registry, LEAGUE, BEST))
    registry.verdicts.close(verdict.id, "reject", {"note": "it is weaker than a bot"})
    rejected = str(why_not_champion(registry, LEAGUE, BEST))
    assert f"it was rejected in verdict {verdict.short_id}: it is weaker than a bot." in rejected
    void(registry, verdict.id, actor="ada", reason="a mistake")
    assert "did not count: voided by ada: a mistake; the next nightly run tests it again" in str(
        why_not_champion(registry, LEAGUE, BEST)
    )
    name = closed(registry, 3, "inconclusive")
    inconclusive = str(why_not_champion(registry, LEAGUE, BEST))
    assert f"verdict {name} on it was inconclusive: it did not pass the test against tictactoe@1." in inconclusive


def test_a_verdict_under_other_conditions(registry: Registry) -> None:
    name = closed(registry, 3, "reject")
    changed = tictactoe.config(play={"opening_plies": 3}, gate=CONFIG.gate.model_dump())
    registry.leagues.register(changed, registry.leagues.get(LEAGUE).interface)
    found = str(why_not_champion(registry, LEAGUE, BEST))
    assert f"has changed since, and after `league void {name}` the next nightly run tests it again." in found


def test_a_version_that_was_champion(registry: Registry) -> None:
    promote(registry, 3)
    promote(registry, 1)
    assert "it was replaced by tictactoe@1 on " in str(why_not_champion(registry, LEAGUE, BEST))
    promote(registry, 3)
    registry.aliases.rollback(LEAGUE, actor="ada", reason="it was slow")
    assert "it was rolled back on " in str(why_not_champion(registry, LEAGUE, BEST))
    assert "by ada (it was slow)" in str(why_not_champion(registry, LEAGUE, BEST))


def test_without_a_champion(tmp_path: Path) -> None:
    registry = league_of(tmp_path, WEAK)
    assert str(why_not_champion(registry, LEAGUE, BEST[2:])).startswith(
        "tictactoe@1 is the best version by rating, but there is no champion: it has not been tested"
    )


def test_doubts_about_a_promotion_by_hand(registry: Registry) -> None:
    first, second, _ = registry.versions.all(LEAGUE)
    assert "tictactoe@2 has played no game under the current conditions" in str(doubts(registry, second))
    evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=2)
    assert doubts(registry, second) is None
    closed(registry, 2, "reject", reason="Not stronger: it scored 40.0 %.")
    assert "the gate has rejected tictactoe@2 in verdict" in str(doubts(registry, second))
    assert str(doubts(registry, second)).endswith(": Not stronger: it scored 40.0 %")
    changed = tictactoe.config(play={"opening_plies": 3}, gate=CONFIG.gate.model_dump())
    registry.leagues.register(changed, registry.leagues.get(LEAGUE).interface)
    assert "has played no game" in str(doubts(registry, first)), "the game has changed"


def test_a_mixture_has_played_if_its_members_have(registry: Registry) -> None:
    mixture = registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 3: 0.5})
    assert "tictactoe@1, tictactoe@3 have played no game" in str(doubts(registry, mixture))
    evaluate(LEAGUE, ["tictactoe@1", "tictactoe@3"], registry=registry, blocks=2)
    assert doubts(registry, mixture) is None
