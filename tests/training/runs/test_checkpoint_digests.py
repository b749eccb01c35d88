"""Digests of checkpoints: a private copy contains what was saved, or is rejected."""

import json
import os
from pathlib import Path

import pytest

from league.errors import ArtifactCorrupt, StorageError
from training.runs.checkpoint_digests import DIGESTS_FILE, private_copy, write_digests


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    checkpoint = tmp_path / "128"
    (checkpoint / "learner").mkdir(parents=True)
    (checkpoint / "learner" / "state.pkl").write_bytes(b"weights")
    (checkpoint / "progress.json").write_text("{}")
    write_digests(checkpoint)
    return checkpoint


def test_a_copy_is_private_and_complete(checkpoint: Path, tmp_path: Path) -> None:
    copy = private_copy(checkpoint, tmp_path / "start")
    assert sorted(path.relative_to(copy).as_posix() for path in copy.rglob("*") if path.is_file()) == [
        "learner/state.pkl",
        "progress.json",
    ]
    assert copy.stat().st_mode & 0o777 == 0o700
    (checkpoint / "learner" / "state.pkl").write_bytes(b"later")
    assert (copy / "learner" / "state.pkl").read_bytes() == b"weights"


def test_an_existing_copy_is_replaced(checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "start").mkdir()
    (tmp_path / "start" / "old.pkl").touch()
    assert not (private_copy(checkpoint, tmp_path / "start") / "old.pkl").exists()


@pytest.mark.parametrize("damage", ["change", "remove", "pipe"])
def test_a_changed_checkpoint_is_rejected(checkpoint: Path, tmp_path: Path, damage: str) -> None:
    state = checkpoint / "learner" / "state.pkl"
    state.unlink()
    if damage == "change":
        state.write_bytes(b"weight5")
    if damage == "pipe":
        os.mkfifo(state)
    message = "was changed" if damage == "change" else "is missing or not a regular file"
    with pytest.raises(ArtifactCorrupt, match=rf"128/learner/state\.pkl {message}"):
        private_copy(checkpoint, tmp_path / "start")


def test_additional_files_are_not_copied(checkpoint: Path, tmp_path: Path) -> None:
    (checkpoint / "learner" / "other.pkl").touch()
    assert not (private_copy(checkpoint, tmp_path / "start") / "learner" / "other.pkl").exists()


def test_a_checkpoint_without_readable_digests_is_rejected(checkpoint: Path, tmp_path: Path) -> None:
    (checkpoint / DIGESTS_FILE).write_text("{")
    with pytest.raises(ArtifactCorrupt, match=r"digests\.json: Invalid JSON"):
        private_copy(checkpoint, tmp_path / "start")
    (checkpoint / DIGESTS_FILE).unlink()
    with pytest.raises(StorageError, match=r"digests\.json cannot be used"):
        private_copy(checkpoint, tmp_path / "start")


def test_paths_outside_the_checkpoint_are_rejected(checkpoint: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("secret")
    (checkpoint / DIGESTS_FILE).write_text(json.dumps({"../secret": "0" * 64}))
    with pytest.raises(ArtifactCorrupt, match="expected a path inside"):
        private_copy(checkpoint, tmp_path / "start")
    assert (tmp_path / "secret").read_text() == "secret"
