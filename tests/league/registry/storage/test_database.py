"""An SQLite file that is moved, restored or replaced while it is in use."""

import shutil
from pathlib import Path

import pytest

from league.errors import StorageError
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import registered


def slugs(registry: Registry) -> list[str]:
    return [row.slug for row in registry.leagues.all()]


def test_a_new_database_is_readable_by_its_owner_only(local: Registry) -> None:
    registered(local)
    home = local.storage.home
    readable = {path.name for path in (home, *home.glob("league.db*")) if path.stat().st_mode & 0o077}
    assert readable <= {"league.db.lock"}, "the lock file is empty"


def test_a_moved_file_is_reported_and_found_again(local: Registry, tmp_path: Path) -> None:
    path = tmp_path / "home" / "league.db"
    before = slugs(local)
    for _ in range(2):
        path.rename(tmp_path / "elsewhere")
        for _ in range(3):
            with pytest.raises(StorageError, match=r"league\.db does not exist"):
                local.leagues.all()
            with pytest.raises(StorageError, match=r"league\.db does not exist"):
                local.publisher.sweep(before[0])
        assert not path.exists(), "a new file was created"
        (tmp_path / "elsewhere").rename(path)
        assert slugs(local) == before


def test_a_replaced_file_is_used_from_then_on(local: Registry, tmp_path: Path) -> None:
    path = tmp_path / "home" / "league.db"
    assert slugs(local)
    Registry.open(Storage.at(tmp_path / "other")).close()
    for part in path.parent.glob("league.db*"):  # includes the write-ahead log
        part.unlink()
    shutil.move(tmp_path / "other" / "league.db", path)
    assert slugs(local) == []
    registered(local)
    assert slugs(Registry.open(local.storage)) == slugs(local) != []


def test_a_reader_creates_no_database(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match=r"league\.db does not exist"):
        Registry.open(Storage.at(tmp_path / "home"), create=False)
    assert not (tmp_path / "home").exists()


@pytest.mark.parametrize("name", ["a b", "50%", "#1", "ümlaut"])
def test_a_home_can_have_any_name(tmp_path: Path, name: str) -> None:
    storage = Storage.at(tmp_path / name)
    Registry.open(storage).close()
    assert (tmp_path / name / "league.db").exists()
    assert slugs(Registry.open(storage, create=False)) == []
