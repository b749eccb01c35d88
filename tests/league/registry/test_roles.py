"""Exploiters are versions with a target. They cannot become champion, and are not selected by default."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from evaluation.gating.nightly import nightly
from evaluation.matches.tournament import evaluate
from league.errors import NotPromotable
from league.policies.loading import eligible
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, MAIN
from league.registry.storage.rows import Portion
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE

REFUSED = r"^tictactoe@2 has the role exploiter \(of tictactoe@1\): it cannot be promoted$"


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """Version 2 is an exploiter of version 1."""
    opened = tictactoe.registry(tmp_path, gate={"max_blocks": 4})
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    tictactoe.publish(opened, tictactoe.graph(wins=True, blocks=True), exploits="tictactoe@1")
    return opened


def test_an_exploiter_cannot_become_champion(registry: Registry) -> None:
    main, exploiter = registry.versions.all(LEAGUE)
    assert (main.role, main.exploits) == (MAIN, None)
    assert (exploiter.role, exploiter.exploits) == (EXPLOITER, "tictactoe@1")
    assert registry.versions.exploiters(LEAGUE, ["tictactoe@1", "tictactoe@2"]) == [exploiter]
    assert registry.versions.exploiters(LEAGUE, ["tictactoe@2"]) == []
    with pytest.raises(NotPromotable, match=REFUSED):
        registry.aliases.set(LEAGUE, "champion", 2, expected=None, actor="test", reason="test")
    with pytest.raises(NotPromotable, match=REFUSED):
        registry.traffic.set(LEAGUE, canary=Portion(2, 0.1), actor="test", reason="test")


def test_a_shadow_that_has_become_an_exploiter_does_not_prevent_a_canary(registry: Registry) -> None:
    registry.aliases.set(LEAGUE, "spar", 1, expected=None, actor="test", reason="test")
    registry.traffic.set(LEAGUE, shadow=Portion("spar", 1.0), actor="test", reason="test")
    registry.aliases.set(LEAGUE, "spar", 2, expected=1, actor="test", reason="test")
    setting = registry.traffic.set(LEAGUE, canary=Portion(1, 0.5), actor="test", reason="test")
    assert (setting.canary, setting.shadow) == (Portion(1, 0.5), Portion("spar", 1.0))
    with pytest.raises(NotPromotable, match=REFUSED):
        registry.traffic.set(LEAGUE, shadow=Portion("spar", 0.5), actor="test", reason="test")


def test_exploiters_play_only_where_they_are_named(registry: Registry) -> None:
    assert [version.number for version in eligible(registry, LEAGUE)] == [1]
    named = evaluate(LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=registry, blocks=1)
    assert {"tictactoe@1", "tictactoe@2"} <= {standing.ref for standing in named.leaderboard}
    report = nightly(registry.leagues.get(LEAGUE).config, registry=registry)
    assert [verdict.candidate for verdict in report.verdicts] == ["tictactoe@1"]
    assert report.faults == ()


def test_a_manifest_names_the_target_of_exploiters_only(registry: Registry) -> None:
    main, exploiter = (version.manifest.model_dump() for version in registry.versions.all(LEAGUE))
    for document in (main | {"exploits": "tictactoe@1"}, exploiter | {"exploits": None}):
        with pytest.raises(ValidationError, match="exploiters name one version"):
            type(registry.versions.get(LEAGUE, 1).manifest).model_validate(document)
