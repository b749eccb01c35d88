"""What people write of versions."""

import pytest

from league.errors import InvalidInput, UnknownAlias, UnknownLeague, UnknownVersion
from league.refs import CheckpointRef
from league.registry.aliases import ANY
from league.registry.notes import LONGEST
from league.registry.registry import Registry
from tests.league.registry.examples import LEAGUE, registered


@pytest.fixture
def versioned(registry: Registry) -> Registry:
    registered(registry, "chess", versions=1)
    return registered(registry, LEAGUE, versions=3)


def texts(registry: Registry, league: str = LEAGUE) -> list[str | None]:
    return [row.note and row.note.text for row in registry.versions(league)]


def test_the_newest_of_each_version_is_shown(versioned: Registry) -> None:
    assert texts(versioned) == [None, None, None]
    versioned.note(CheckpointRef(LEAGUE, 2), "first", actor="ada")
    written = versioned.note(CheckpointRef(LEAGUE, 2), "  more entropy\n", actor="bob").note
    versioned.note(CheckpointRef(LEAGUE, 1), "another", actor="ada")
    assert texts(versioned) == ["another", "more entropy", None]
    assert texts(versioned, "chess") == [None]
    assert written is not None
    assert (written.text, written.actor) == ("more entropy", "bob")
    assert versioned.version(LEAGUE, 2).note == written
    assert [row.note for row in versioned.newest_versions(LEAGUE, limit=2)] == [None, written]


def test_an_empty_one_takes_it_away(versioned: Registry) -> None:
    versioned.note(CheckpointRef(LEAGUE, 2), "first", actor="ada")
    assert versioned.note(CheckpointRef(LEAGUE, 2), " ", actor="ada").note is None
    assert texts(versioned) == [None, None, None]
    versioned.note(CheckpointRef(LEAGUE, 2), "again", actor="ada")
    assert texts(versioned) == [None, "again", None]


def test_the_same_again_changes_nothing(versioned: Registry) -> None:
    first = versioned.note(CheckpointRef(LEAGUE, 2), "a try", actor="ada").note
    seen = versioned.pulse(LEAGUE)
    assert versioned.note(CheckpointRef(LEAGUE, 2), "a try ", actor="bob").note == first
    assert versioned.note(CheckpointRef(LEAGUE, 1), "", actor="bob").note is None
    assert versioned.pulse(LEAGUE) == seen


def test_an_alias_names_the_version_that_it_points_at_now(versioned: Registry) -> None:
    versioned.set_alias(LEAGUE, "champion", 3, expected=ANY, actor="test", reason="test")
    assert versioned.note(CheckpointRef(LEAGUE, "champion"), "won", actor="ada").number == 3
    versioned.set_alias(LEAGUE, "champion", 1, expected=ANY, actor="test", reason="test")
    assert texts(versioned) == [None, None, "won"]


def test_what_cannot_be_written_leaves_what_was(versioned: Registry) -> None:
    versioned.note(CheckpointRef(LEAGUE, 1), "x" * LONGEST, actor="ada")
    for ref, text, error in (
        (CheckpointRef(LEAGUE, 1), "x" * (LONGEST + 1), InvalidInput),
        (CheckpointRef(LEAGUE, 1), "a\0b", InvalidInput),
        (CheckpointRef(LEAGUE, 1), "a\udcffb", InvalidInput),
        (CheckpointRef(LEAGUE, 9), "x", UnknownVersion),
        (CheckpointRef(LEAGUE, "candidate"), "x", UnknownAlias),
        (CheckpointRef("nobody", 1), "x", UnknownLeague),
    ):
        with pytest.raises(error):
            versioned.note(ref, text, actor="ada")
    assert texts(versioned) == ["x" * LONGEST, None, None]
