"""Notes on versions. Exploiters cannot become champion, and are not selected by default."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from league.errors import InvalidInput, NotPromotable, UnknownAlias, UnknownVersion
from league.policies.loading import check_eligible, eligible
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, MAIN
from league.registry.storage.rows import Portion
from league.registry.versions import MAX_NOTE_LENGTH
from tests.support.leagues import tictactoe
from tests.support.leagues.registries import LEAGUE, registered


@pytest.fixture
def versioned(registry: Registry) -> Registry:
    registered(registry, "chess", versions=1)
    return registered(registry, LEAGUE, versions=3)


def texts(registry: Registry, league: str = LEAGUE) -> list[str | None]:
    return [row.note and row.note.text for row in registry.versions.all(league)]


def test_the_latest_note_of_each_version_is_shown(versioned: Registry) -> None:
    def note(version: int | str, text: str, actor: str = "ada") -> Any:
        return versioned.versions.set_note(CheckpointRef(LEAGUE, version), text, actor=actor)

    assert texts(versioned) == [None, None, None]
    note(2, "first")
    written = note(2, "  more entropy\n", "bob").note
    note(1, "another")
    assert texts(versioned) == ["another", "more entropy", None]
    assert texts(versioned, "chess") == [None]
    assert (written.text, written.actor) == ("more entropy", "bob")
    assert versioned.versions.get(LEAGUE, 2).note == written
    assert [row.note for row in versioned.versions.newest(LEAGUE, limit=2)] == [None, written]
    token = versioned.changes.token(LEAGUE)
    assert note(2, "more entropy ", "ann").note == written
    assert note(3, "").note is None
    assert versioned.changes.token(LEAGUE) == token, "unchanged notes have no effect"
    assert note(2, " ").note is None
    versioned.aliases.set(LEAGUE, "champion", 3, expected=ANY, actor="test", reason="test")
    assert note("champion", "won").number == 3
    versioned.aliases.set(LEAGUE, "champion", 1, expected=ANY, actor="test", reason="test")
    assert texts(versioned) == ["another", None, "won"]


def test_an_invalid_note_changes_nothing(versioned: Registry) -> None:
    versioned.versions.set_note(CheckpointRef(LEAGUE, 1), "x" * MAX_NOTE_LENGTH, actor="ada")
    for ref, text, error in (
        (CheckpointRef(LEAGUE, 1), "x" * (MAX_NOTE_LENGTH + 1), InvalidInput),
        (CheckpointRef(LEAGUE, 1), "a\0b", InvalidInput),
        (CheckpointRef(LEAGUE, 1), "a\udcffb", InvalidInput),
        (CheckpointRef(LEAGUE, 9), "x", UnknownVersion),
        (CheckpointRef(LEAGUE, "candidate"), "x", UnknownAlias),
    ):
        with pytest.raises(error):
            versioned.versions.set_note(ref, text, actor="ada")
    assert texts(versioned) == ["x" * MAX_NOTE_LENGTH, None, None]


REFUSED = r"^tictactoe@2 has the role exploiter \(of tictactoe@1\): it cannot be promoted$"


@pytest.fixture
def exploited(tmp_path: Path) -> Registry:
    """Version 2 is an exploiter of version 1."""
    opened = tictactoe.registry(tmp_path, gate={"max_blocks": 4})
    tictactoe.publish(opened, tictactoe.graph(wins=True))
    tictactoe.publish(opened, tictactoe.graph(wins=True, blocks=True), exploits="tictactoe@1")
    return opened


def test_an_exploiter_cannot_become_champion(exploited: Registry) -> None:
    main, exploiter = exploited.versions.all(LEAGUE)
    assert (main.role, main.exploits) == (MAIN, None)
    assert (exploiter.role, exploiter.exploits) == (EXPLOITER, "tictactoe@1")
    assert exploited.versions.exploiters(LEAGUE, ["tictactoe@1", "tictactoe@2"]) == [exploiter]
    assert exploited.versions.exploiters(LEAGUE, ["tictactoe@2"]) == []
    with pytest.raises(NotPromotable, match=REFUSED):
        exploited.aliases.set(LEAGUE, "champion", 2, expected=None, actor="test", reason="test")
    with pytest.raises(NotPromotable, match=REFUSED):
        exploited.traffic.set(LEAGUE, canary=Portion(2, 0.1), actor="test", reason="test")


def test_a_shadow_that_has_become_an_exploiter_does_not_prevent_a_canary(exploited: Registry) -> None:
    exploited.aliases.set(LEAGUE, "spar", 1, expected=None, actor="test", reason="test")
    exploited.traffic.set(LEAGUE, shadow=Portion("spar", 1.0), actor="test", reason="test")
    exploited.aliases.set(LEAGUE, "spar", 2, expected=1, actor="test", reason="test")
    setting = exploited.traffic.set(LEAGUE, canary=Portion(1, 0.5), actor="test", reason="test")
    assert (setting.canary, setting.shadow) == (Portion(1, 0.5), Portion("spar", 1.0))
    with pytest.raises(NotPromotable, match=REFUSED):
        exploited.traffic.set(LEAGUE, shadow=Portion("spar", 0.5), actor="test", reason="test")


def test_exploiters_play_only_where_they_are_named(exploited: Registry) -> None:
    assert [version.number for version in eligible(exploited, LEAGUE)] == [1]
    check_eligible("tictactoe@2", exploited, exploited.leagues.get(LEAGUE).config)


def test_a_manifest_names_the_target_of_exploiters_only(exploited: Registry) -> None:
    main, exploiter = (version.manifest.model_dump() for version in exploited.versions.all(LEAGUE))
    for document in (main | {"exploits": "tictactoe@1"}, exploiter | {"exploits": None}):
        with pytest.raises(ValidationError, match="exploiters name one version"):
            type(exploited.versions.get(LEAGUE, 1).manifest).model_validate(document)
