"""Checkpoints are published in order, each version with the one before as its parent."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from league.errors import ArtifactCorrupt
from training.runs import publish_queue
from training.runs.checkpoint_digests import write_digests
from training.runs.publish_queue import PublishQueue


@pytest.fixture
def published(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Versions of the run, with `parent` as passed to `publish`. A checkpoint named 666 cannot be exported."""
    versions: list[Any] = []

    def publish(checkpoint: Any, *, parent: int | None, **_: Any) -> Any:
        if checkpoint.steps == 666:
            raise RuntimeError("no export")
        versions.append(SimpleNamespace(number=len(versions) + 1, steps=checkpoint.steps, parent=parent))
        return versions[-1]

    monkeypatch.setattr(publish_queue, "publish", publish)
    monkeypatch.setattr(publish_queue, "published_versions", lambda *_: list(versions))
    return versions


def queue_of(parent: int | None = None) -> PublishQueue:
    run: Any = SimpleNamespace(
        id="run", record=SimpleNamespace(config=None, parent=parent, git_commit=None, exploits=None)
    )
    unused: Any = None
    return PublishQueue(run, unused, unused, announce=lambda row: None)


def checkpoints(directory: Path, *steps: int) -> list[Path]:
    paths = [directory / str(number) for number in steps]
    for path in paths:
        path.mkdir()
        (path / "state.pkl").write_bytes(b"weights")
        write_digests(path)
    return paths


def test_each_version_has_the_one_before_as_its_parent(published: list[Any], tmp_path: Path) -> None:
    paths, queue = checkpoints(tmp_path, 512, 1024, 1536, 2048), queue_of(parent=7)
    for path in paths:
        queue.add(path)
    queue.join()
    assert [(version.steps, version.parent) for version in published] == [(512, 7), (1024, 1), (1536, 2), (2048, 3)]
    assert not any(path.exists() for path in paths), "published checkpoints are deleted"


def test_nothing_is_published_after_a_failure(published: list[Any], tmp_path: Path) -> None:
    paths, queue = checkpoints(tmp_path, 512, 666, 1024), queue_of()
    for path in paths:
        queue.add(path)
    with pytest.raises(RuntimeError, match="no export"):
        queue.join()
    assert [version.steps for version in published] == [512]
    assert [path.exists() for path in paths] == [False, True, True], "later checkpoints remain on disk"


def test_a_damaged_checkpoint_is_not_published(published: list[Any], tmp_path: Path) -> None:
    paths, queue = checkpoints(tmp_path, 512), queue_of()
    (paths[0] / "state.pkl").write_bytes(b"weight5")
    queue.add(paths[0])
    with pytest.raises(ArtifactCorrupt, match=r"512/state\.pkl was changed"):
        queue.join()
    assert published == []
