import os
from pathlib import Path

import pytest

from league.errors import StorageError
from league.files import disk_errors, move_durably, replacing


def test_a_file_is_replaced_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    path.write_text("old")
    with replacing(path) as draft:
        draft.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_leaves_the_old_file_and_no_temporary_file(tmp_path: Path) -> None:
    path = tmp_path / "record.json"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError), replacing(path) as draft:
        draft.write_text("half" * 10_000 + "\ud800", encoding="utf-8")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_names_the_file_that_was_to_be_replaced(tmp_path: Path) -> None:
    (tmp_path / "directory").mkdir()
    (tmp_path / "file").write_text("")
    for name, reason in (
        ("nowhere/page.html", "No such file or directory"),
        ("directory", "Is a directory"),
        ("file/page.html", "Not a directory"),
    ):
        path = tmp_path / name
        with pytest.raises(StorageError) as raised, disk_errors(path, action="written"), replacing(path) as draft:
            draft.write_text("new")
        assert str(raised.value) == f"{path} cannot be written: {reason}"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["directory", "file"]


def test_a_directory_is_moved_once_its_content_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory, target = tmp_path / "600.part", tmp_path / "600"
    (directory / "learner").mkdir(parents=True)
    (directory / "learner" / "state.pkl").write_text("weights")
    (directory / "progress.json").write_text("{}")
    inodes = {path.stat().st_ino: path.name for path in (tmp_path, directory, *directory.rglob("*"))}
    flushed: list[tuple[str, bool]] = []
    monkeypatch.setattr(os, "fsync", lambda number: flushed.append((inodes[os.fstat(number).st_ino], target.exists())))
    move_durably(directory, target)
    assert flushed == [
        ("state.pkl", False),
        ("learner", False),
        ("progress.json", False),
        ("600.part", False),
        (tmp_path.name, True),
    ]
    assert not directory.exists()
    assert (target / "learner" / "state.pkl").read_text() == "weights"
