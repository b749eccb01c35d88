"""Notes on versions."""

from typing import Any

import pytest

from league.errors import InvalidInput, UnknownAlias, UnknownLeague, UnknownVersion
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.versions import MAX_NOTE_LENGTH
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
        (CheckpointRef("nobody", 1), "x", UnknownLeague),
    ):
        with pytest.raises(error):
            versioned.versions.set_note(ref, text, actor="ada")
    assert texts(versioned) == ["x" * MAX_NOTE_LENGTH, None, None]
