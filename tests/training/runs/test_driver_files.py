"""A learner on another machine than the driver reads and writes the files of the run."""

from pathlib import Path

import pytest
import ray

from league.files import files_in
from training.runs import driver_files
from training.runs.driver_files import DriverFiles, FileActor, RemoteDriverFiles

CONTENT = {"weights.bin": bytes(range(256)) * 40, "part/empty": b"", "part/one": b"1"}


@pytest.fixture(params=["here", "elsewhere"])
def files(
    request: pytest.FixtureRequest, ray_session: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> DriverFiles:
    if request.param == "here":
        return DriverFiles()
    monkeypatch.setattr(driver_files, "CHUNK", 1000)
    monkeypatch.setattr(driver_files, "POLL", 0.0)
    return RemoteDriverFiles(ray.remote(FileActor).options(num_cpus=0).remote())


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
