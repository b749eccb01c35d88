"""Only bytes with the digest of the manifest are used."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from league.errors import ArtifactCorrupt, FilesMissing, UnknownVersion
from league.registry.registry import Registry
from league.registry.storage.manifest import TRAINING
from tests.support.leagues.registries import GRAPH, LEAGUE, publish


def _flip_a_bit(directory: Path) -> None:
    content = bytearray((directory / "shared.onnx").read_bytes())
    content[5] ^= 1
    (directory / "shared.onnx").write_bytes(content)


def _link_training_elsewhere(directory: Path) -> None:
    (directory / "training").rename(directory.parent / "elsewhere")
    (directory / "training").symlink_to(directory.parent / "elsewhere")


def _forge_the_manifest(directory: Path) -> None:
    manifest = directory / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"steps": 1000', '"steps": 9000'))


TAMPERING: list[tuple[Callable[[Path], object], str]] = [
    (_flip_a_bit, r"shared\.onnx was changed"),
    (lambda directory: (directory / "training" / "state.bin").unlink(), r"state\.bin is missing"),
    (lambda directory: (directory / "training" / "more.pkl").touch(), r"more\.pkl does not belong to"),
    (_link_training_elsewhere, r"training does not belong to"),
    (_forge_the_manifest, r"manifest\.json was changed"),
    (lambda directory: directory.rename(directory.parent / "gone"), r"manifest\.json is missing"),
]


@pytest.mark.parametrize(("tamper", "message"), TAMPERING)
def test_tampering_is_detected_and_the_file_named(
    local: Registry, tamper: Callable[[Path], object], message: str
) -> None:
    publish(local, "run/1")
    tamper(local.versions.fetch(LEAGUE, 1))
    with pytest.raises(ArtifactCorrupt, match=message) as caught:
        local.versions.fetch(LEAGUE, 1)
    assert "\n" not in str(caught.value)


def test_a_single_file_is_verified(local: Registry) -> None:
    version = publish(local, "run/1")
    assert local.artifacts.read(version.manifest, "shared.onnx") == GRAPH
    _flip_a_bit(local.artifacts.path(LEAGUE, 1))
    with pytest.raises(ArtifactCorrupt, match=r"shared\.onnx was changed"):
        local.artifacts.read(version.manifest, "shared.onnx")


def test_a_version_that_is_not_ready_cannot_be_fetched(local: Registry) -> None:
    with pytest.raises(UnknownVersion):
        local.versions.fetch(LEAGUE, 1)


def test_the_first_version_of_a_league_survives_a_power_failure(
    registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The directory that contains the league's directory is on the disk, too."""
    flushed: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda number: flushed.append(os.readlink(f"/proc/self/fd/{number}")))
    publish(registry, "run/1")
    assert flushed[-2:] == [str(registry.artifacts.root / LEAGUE), str(registry.artifacts.root)]


def test_a_folder_is_copied_with_verified_files(local: Registry, tmp_path: Path) -> None:
    version = publish(local, "run")
    source, target = local.artifacts.path(LEAGUE, version.number), tmp_path / "copy"
    assert local.versions.copy(LEAGUE, version.number, TRAINING, target) == target
    names = sorted(path.relative_to(source / TRAINING) for path in (source / TRAINING).rglob("*") if path.is_file())
    assert names
    assert sorted(path.relative_to(target) for path in target.rglob("*") if path.is_file()) == names
    assert all((target / name).read_bytes() == (source / TRAINING / name).read_bytes() for name in names)
    assert target.stat().st_mode & 0o777 == 0o700


def test_a_changed_file_is_not_copied(local: Registry, tmp_path: Path) -> None:
    version = publish(local, "run")
    directory = local.artifacts.path(LEAGUE, version.number) / TRAINING
    state = next(path for path in directory.iterdir() if path.is_file())
    state.write_bytes(b"a pickle")
    with pytest.raises(ArtifactCorrupt, match=r"training/.* was changed"):
        local.versions.copy(LEAGUE, version.number, TRAINING, tmp_path / "copy")


def test_the_place_of_deleted_files_is_not_public(local: Registry) -> None:
    publish(local, "run/1")
    directory = local.versions.fetch(LEAGUE, 1)
    shutil.rmtree(directory)
    with pytest.raises(FilesMissing, match=re.escape(f"{directory} does not exist; ")) as caught:
        local.versions.fetch(LEAGUE, 1)
    assert caught.value.public_message == f"{LEAGUE}/1/manifest.json is missing"
