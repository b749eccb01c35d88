"""Files of a run that a learner on another machine reads and writes, and the digests of checkpoints."""

import json
import os
from pathlib import Path
from typing import Any

import pytest
import ray

from league.errors import ArtifactCorrupt, StorageError
from league.files import files_in
from training.runs import driver_files
from training.runs.checkpoint_digests import DIGESTS_FILE, private_copy, write_digests
from training.runs.driver_files import DriverFiles, FileActor, RemoteDriverFiles

CONTENT = {"weights.bin": bytes(range(256)) * 40, "part/empty": b"", "part/one": b"1"}


@pytest.fixture(scope="module")
def actor(ray_session: None) -> Any:
    return ray.remote(FileActor).options(num_cpus=0).remote()


@pytest.fixture(params=["here", "elsewhere"])
def files(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> DriverFiles:
    if request.param == "here":
        return DriverFiles()
    monkeypatch.setattr(driver_files, "CHUNK", 1000)
    monkeypatch.setattr(driver_files, "POLL", 0.0)
    return RemoteDriverFiles(request.getfixturevalue("actor"))


def write(directory: Path) -> None:
    for name, content in CONTENT.items():
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_bytes(content)


def content(directory: Path) -> dict[str, bytes]:
    return {name: (directory / name).read_bytes() for name in files_in(directory)}


def test_a_checkpoint_arrives_whole(files: DriverFiles, tmp_path: Path) -> None:
    target = tmp_path / "checkpoints" / "512"
    target.parent.mkdir()
    draft = files.draft(target)
    write(draft)
    files.commit(draft, target)
    assert content(target) == CONTENT
    assert not draft.exists()
    assert list(target.parent.iterdir()) == [target], "nothing half-written is left"


def test_what_an_interrupted_learner_left_is_not_part_of_a_checkpoint(files: DriverFiles, tmp_path: Path) -> None:
    target = tmp_path / "512"
    (left := target.with_name("512.part")).mkdir()
    (left / "weights.bin").write_bytes(b"half")
    draft = files.draft(target)
    write(draft)
    files.commit(draft, target)
    assert content(target) == CONTENT


def test_the_state_to_start_from_is_fetched(files: DriverFiles, tmp_path: Path) -> None:
    write(tmp_path / "start")
    assert content(files.fetch(tmp_path / "start")) == CONTENT


def test_a_stop_request_is_seen(files: DriverFiles, tmp_path: Path) -> None:
    assert not files.exists(tmp_path / "stop")
    (tmp_path / "stop").touch()
    assert files.exists(tmp_path / "stop")


def test_older_checkpoints_are_removed(files: DriverFiles, tmp_path: Path) -> None:
    for steps in (1, 2, 3):
        write(tmp_path / str(steps))
    files.keep_only(tmp_path / "3")
    assert list(tmp_path.iterdir()) == [tmp_path / "3"]


def test_private_copies_end_with_the_learner(files: DriverFiles, tmp_path: Path) -> None:
    write(tmp_path / "start")
    copy = files.fetch(tmp_path / "start")
    files.close()
    assert content(tmp_path / "start") == CONTENT
    assert copy.exists() == (copy == tmp_path / "start")


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    checkpoint = tmp_path / "128"
    (checkpoint / "learner").mkdir(parents=True)
    (checkpoint / "learner" / "state.pkl").write_bytes(b"weights")
    (checkpoint / "progress.json").write_text("{}")
    write_digests(checkpoint)
    return checkpoint


def test_a_copy_is_private_complete_and_without_additional_files(checkpoint: Path, tmp_path: Path) -> None:
    (checkpoint / "learner" / "other.pkl").touch()
    (tmp_path / "start").mkdir()
    (tmp_path / "start" / "old.pkl").touch()
    copy = private_copy(checkpoint, tmp_path / "start")
    assert files_in(copy) == ["learner/state.pkl", "progress.json"]
    assert copy.stat().st_mode & 0o777 == 0o700
    (checkpoint / "learner" / "state.pkl").write_bytes(b"later")
    assert (copy / "learner" / "state.pkl").read_bytes() == b"weights"


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
