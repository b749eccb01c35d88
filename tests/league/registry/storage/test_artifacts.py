"""Both artefact stores, a directory and an object store, publish completely and return only verified bytes."""

import os
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from league.errors import ArtifactCorrupt, FilesMissing, UnknownVersion, VersionRetired
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from tests.support.leagues.registries import GRAPH, LEAGUE, builder, publish, verified


def test_the_first_version_of_a_league_survives_a_power_failure(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The directory that contains the league's directory is on the disk, too."""
    flushed: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda number: flushed.append(os.readlink(f"/proc/self/fd/{number}")))
    publish(registry, "run/1")
    assert flushed[-2:] == [str(registry.artifacts.root / LEAGUE), str(registry.artifacts.root)]


def test_the_place_of_deleted_files_is_not_public(registry: Registry) -> None:
    publish(registry, "run/1")
    directory = registry.artifacts.path(LEAGUE, 1)
    shutil.rmtree(directory)
    with pytest.raises(FilesMissing, match=re.escape(f"{directory} does not exist; ")) as caught:
        verified(registry, 1)
    assert caught.value.public_message == f"{LEAGUE}/1/manifest.json is missing"


FILES = ["manifest.json", "shared.onnx", "training/learner/weights.bin", "training/state.bin"]


def test_the_training_state_is_copied_and_verified(store: Any, tmp_path: Path) -> None:
    publish(store.registry, "run/1")
    copied = store.registry.versions.copy(LEAGUE, 1, TRAINING, tmp_path / "copy")
    assert copied == tmp_path / "copy"
    contents = {path.relative_to(copied).as_posix(): path.read_bytes() for path in copied.rglob("*.bin")}
    assert contents == {"state.bin": bytes(range(256)), "learner/weights.bin": b"weights"}
    assert copied.stat().st_mode & 0o777 == 0o700
    store.replace(f"{LEAGUE}/1/training/state.bin", b"a pickle")
    with pytest.raises(ArtifactCorrupt, match=r"training/state\.bin was changed"):
        store.registry.versions.copy(LEAGUE, 1, TRAINING, tmp_path / "again")


def test_a_removed_training_state_is_reported_as_retired(store: Any, tmp_path: Path) -> None:
    version = publish(store.registry, "run/1")
    store.registry.artifacts.remove_training(LEAGUE, 1)
    assert store.registry.artifacts.training_size(LEAGUE, 1) == 0
    with pytest.raises(VersionRetired, match="has no training state any more"):
        store.registry.versions.copy(LEAGUE, 1, TRAINING, tmp_path / "copy")
    assert store.registry.artifacts.read(version.manifest, "shared.onnx") == GRAPH
    verified(store.registry, 1)


def test_a_version_is_published_with_all_files_or_none(store: Any) -> None:
    registry = store.registry
    with pytest.raises(UnknownVersion):
        verified(registry, 1)
    version = publish(registry, "run/1")
    assert store.names() == [f"{LEAGUE}/1/{name}" for name in FILES]
    assert registry.artifacts.read(version.manifest, "shared.onnx") == GRAPH
    assert registry.artifacts.last(LEAGUE) == 1
    assert registry.artifacts.size(LEAGUE, 1) > registry.artifacts.training_size(LEAGUE, 1) == 263
    registry.artifacts.discard(LEAGUE, 1)
    assert store.names() == []
    with pytest.raises(Exception, match="expected"):
        registry.publisher.publish(LEAGUE, builder(parent=9), source="run/2")
    assert store.names() == []


@pytest.mark.parametrize("name", ["shared.onnx", "manifest.json", "training/state.bin"])
def test_a_changed_or_missing_file_is_detected_and_named(store: Any, name: str) -> None:
    version = publish(store.registry, "run/1")
    store.replace(f"{LEAGUE}/1/{name}", b"tampered")
    with pytest.raises(ArtifactCorrupt, match=f"{LEAGUE}/1/{name} was changed") as caught:
        verified(store.registry, 1)
    assert "\n" not in str(caught.value)
    if name == "shared.onnx":
        with pytest.raises(ArtifactCorrupt, match=r"shared\.onnx was changed"):
            store.registry.artifacts.read(version.manifest, name)
    store.remove(f"{LEAGUE}/1/{name}")
    with pytest.raises(ArtifactCorrupt, match=f"{LEAGUE}/1/{name} is missing"):
        verified(store.registry, 1)


def test_what_does_not_belong_to_a_version_is_named(registry: Registry) -> None:
    publish(registry, "run/1")
    directory = registry.artifacts.path(LEAGUE, 1)
    (directory / "training" / "more.pkl").touch()
    with pytest.raises(ArtifactCorrupt, match=r"more\.pkl does not belong to"):
        verified(registry, 1)
    (directory / "training" / "more.pkl").unlink()
    (directory / "training").rename(directory.parent / "elsewhere")
    (directory / "training").symlink_to(directory.parent / "elsewhere")
    with pytest.raises(ArtifactCorrupt, match=r"training does not belong to"):
        verified(registry, 1)
