"""Anchors: who they are, and that nobody passes who is inferior to one."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from evaluation.anchors import anchors_of, earlier_champions
from evaluation.nightly import nightly
from evaluation.verification import verify
from league.config import LeagueConfig
from league.errors import ConfigError, UnknownPolicy
from league.registry.registry import Registry
from tests.evaluation import examples
from tests.evaluation.test_nightly import MIDDLING, STRONG, STRONGEST, WEAK, league_of


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    opened = league_of(tmp_path / "home", WEAK, MIDDLING, STRONG, STRONGEST)
    yield opened
    opened.close()


def config(**gate: Any) -> LeagueConfig:
    return examples.config(play={"opening_plies": 2, "copies": 4}, gate=gate)


def crown(registry: Registry, *versions: int) -> None:
    for version in versions:
        now = registry.aliases(examples.LEAGUE).get("champion")
        registry.set_alias(examples.LEAGUE, "champion", version, expected=now, actor="me", reason="test")


def refs(registry: Registry, league: LeagueConfig, candidate: int, champion: str) -> list[str]:
    registry.register(league, registry.league(examples.LEAGUE).interface)
    return [anchor.ref for anchor in anchors_of(registry, registry.league(examples.LEAGUE), candidate, champion)]


def test_named_anchors_come_first_then_champions_newest_first(registry: Registry) -> None:
    crown(registry, 1, 2, 3)
    league = config(anchors=["script:random"], earlier_champions=2)
    assert refs(registry, league, 4, "tictactoe@3") == ["script:random", "tictactoe@2", "tictactoe@1"]
    assert refs(registry, config(earlier_champions=1), 4, "tictactoe@3") == ["tictactoe@2"]
    assert refs(registry, config(earlier_champions=0), 4, "tictactoe@3") == []


def test_nobody_is_its_own_anchor_and_an_alias_is_pinned(registry: Registry) -> None:
    crown(registry, 1, 2)
    registry.set_alias(examples.LEAGUE, "gold", 3, expected=None, actor="me", reason="test")
    league = config(anchors=["@gold", "@silver", "@4", "tictactoe@2", "@champion"], earlier_champions=9)
    assert refs(registry, league, 4, "tictactoe@2") == ["tictactoe@3", "tictactoe@1"]


def test_a_champion_that_was_rolled_back_is_no_anchor(registry: Registry) -> None:
    crown(registry, 1, 2, 3)
    registry.rollback(examples.LEAGUE, actor="me", reason="broken")
    assert earlier_champions(registry, registry.league(examples.LEAGUE)) == ["tictactoe@1"]


def test_an_anchor_that_does_not_exist_is_named_and_nobody_is_judged(registry: Registry) -> None:
    with pytest.raises(UnknownPolicy, match="stockfish"):
        refs(registry, config(anchors=["script:stockfish"]), 4, "tictactoe@1")
    report = nightly(config(anchors=["@77"]), registry=registry)
    assert report.verdicts == ()
    assert all("77" in fault for fault in report.faults)


def test_who_beats_the_champion_but_not_an_anchor_is_not_promoted(tmp_path: Path) -> None:
    """The trap: version 3 beats the champion, and would be promoted. The script that wins and blocks beats it."""
    registry = league_of(tmp_path / "trap", WEAK, MIDDLING, STRONG)
    crown(registry, 1, 2)
    league = config(anchors=["script:one_ply"], earlier_champions=0, elo1=60, margin=30)
    report = nightly(league, registry=registry)
    refused = {verdict.candidate: verdict for verdict in report.verdicts}["tictactoe@3"]
    assert (refused.outcome, refused.promoted) == ("reject", False)
    assert refused.note == "it beat the champion, but is weaker than script:one_ply"
    assert refused.llr >= refused.bounds[1]
    (anchor,) = refused.anchors
    assert (anchor.outcome, anchor.margin) == ("inferior", 30)
    assert anchor.llr <= anchor.bounds[0]
    assert sum(anchor.counts) == anchor.blocks
    assert registry.aliases(examples.LEAGUE)["champion"] == 2
    assert verify(refused.verdict, registry=registry, replays=4).matches > refused.blocks


def test_who_passes_all_anchors_is_promoted_and_the_audit_says_so(registry: Registry) -> None:
    crown(registry, 1, 2)
    league = config(anchors=["script:random"], earlier_champions=1, margin=60)
    nightly(league, registry=registry)
    event = next(event for event in registry.history(examples.LEAGUE) if event.version == 3)
    assert "is not inferior to script:random, tictactoe@1" in event.reason
    row = registry.verdict(str(event.verdict))
    assert row.evidence is not None
    assert [anchor["outcome"] for anchor in row.evidence["anchors"]] == ["not inferior", "not inferior"]
    assert verify(row.id, registry=registry).outcome == "promote"


@pytest.mark.parametrize(
    ("gate", "words"),
    [
        ({"anchors": [{"ref": "script:random", "margin": 300}]}, "margins must lie within ±190"),
        ({"anchors": [{"ref": "script:random", "margins": 3}]}, "did you mean 'margin'"),
        ({"margin": 0}, "gate.margin"),
        ({"model": "returns"}, "return_bound"),
        ({"model": "returns", "return_bound": 2}, "margin must be smaller"),
        ({"model": "returns", "return_bound": 200, "return0": 3, "return1": 2}, "return0 first"),
        ({"nights": 0}, "gate.nights"),
    ],
)
def test_a_gate_that_cannot_be_is_refused_by_name(gate: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        config(**gate)
