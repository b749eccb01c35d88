"""An SQLite file that is moved away, comes back, or is replaced while it is in use."""

import shutil
from pathlib import Path

import pytest

from league.errors import StorageError
from league.registry.registry import Registry
from league.settings import Storage
from tests.league.registry.examples import registered


def slugs(registry: Registry) -> list[str]:
    return [row.slug for row in registry.leagues()]


def test_a_file_that_is_moved_away_is_missed_and_found_again(local: Registry, tmp_path: Path) -> None:
    path = tmp_path / "home" / "league.db"
    before = slugs(local)
    for _ in range(2):
        path.rename(tmp_path / "elsewhere")
        for _ in range(3):
            with pytest.raises(StorageError, match=r"league\.db is not there"):
                local.leagues()
            with pytest.raises(StorageError, match=r"league\.db is not there"):
                local.sweep(before[0])
        assert not path.exists(), "no empty one was put into its place"
        (tmp_path / "elsewhere").rename(path)
        assert slugs(local) == before


def test_a_file_that_is_replaced_is_read_from_then_on(local: Registry, tmp_path: Path) -> None:
    path = tmp_path / "home" / "league.db"
    assert slugs(local)
    Registry.open(Storage.at(tmp_path / "other")).close()
    for part in path.parent.glob("league.db*"):  # its write-ahead log belongs to it
        part.unlink()
    shutil.move(tmp_path / "other" / "league.db", path)
    assert slugs(local) == []
    registered(local)
    assert slugs(Registry.open(local.storage)) == slugs(local) != []


def test_who_only_follows_makes_no_database(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"league\.db is not there"):
        Registry.open(Storage.at(tmp_path / "home"), create=False)
    assert not (tmp_path / "home").exists()


@pytest.mark.parametrize("name", ["a b", "50%", "#1", "ümlaut"])
def test_a_home_may_have_any_name(tmp_path: Path, name: str) -> None:
    storage = Storage.at(tmp_path / name)
    Registry.open(storage).close()
    assert (tmp_path / name / "league.db").exists()
    assert slugs(Registry.open(storage, create=False)) == []
