"""Both artefact stores, a directory and an object store, publish completely and return only verified bytes."""

from pathlib import Path
from typing import Any

import pytest

from league.errors import ArtifactCorrupt, VersionRetired
from league.registry.storage.manifest import TRAINING
from tests.support.leagues.registries import GRAPH, LEAGUE, builder, publish

FILES = ["manifest.json", "shared.onnx", "training/learner/weights.bin", "training/state.bin"]


def test_a_version_is_published_with_all_files(store: Any) -> None:
    version = publish(store.registry, "run/1")
    assert store.names() == [f"{LEAGUE}/1/{name}" for name in FILES]
    assert store.registry.artifacts.read(version.manifest, "shared.onnx") == GRAPH
    assert store.registry.artifacts.last(LEAGUE) == 1
    assert store.registry.artifacts.size(LEAGUE, 1) > store.registry.artifacts.training_size(LEAGUE, 1) == 263


@pytest.mark.parametrize("name", ["shared.onnx", "manifest.json", "training/state.bin"])
def test_a_changed_file_is_detected_and_named(store: Any, name: str) -> None:
    publish(store.registry, "run/1")
    store.replace(f"{LEAGUE}/1/{name}", b"tampered")
    with pytest.raises(ArtifactCorrupt, match=f"{LEAGUE}/1/{name} was changed"):
        store.registry.versions.fetch(LEAGUE, 1)


@pytest.mark.parametrize("name", ["shared.onnx", "manifest.json", "training/state.bin"])
def test_a_missing_file_is_detected_and_named(store: Any, name: str) -> None:
    publish(store.registry, "run/1")
    store.remove(f"{LEAGUE}/1/{name}")
    with pytest.raises(ArtifactCorrupt, match=f"{LEAGUE}/1/{name} is missing"):
        store.registry.versions.fetch(LEAGUE, 1)


def test_the_training_state_is_copied_and_verified(store: Any, tmp_path: Path) -> None:
    publish(store.registry, "run/1")
    copied = store.registry.versions.copy(LEAGUE, 1, TRAINING, tmp_path / "copy")
    assert (copied / "learner" / "weights.bin").read_bytes() == b"weights"
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
    store.registry.versions.fetch(LEAGUE, 1)


def test_a_failed_publication_leaves_nothing(store: Any) -> None:
    with pytest.raises(Exception, match="expected"):
        store.registry.publisher.publish(LEAGUE, builder(parent=9), source="run/1")
    assert store.names() == []


def test_a_discarded_version_leaves_nothing(store: Any) -> None:
    publish(store.registry, "run/1")
    store.registry.artifacts.discard(LEAGUE, 1)
    assert store.names() == []
