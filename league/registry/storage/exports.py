"""Writes the files of a version for use in other programs: graphs, probes and the manifest."""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from league.errors import ConfigError
from league.files import disk_errors, move_durably, replacing
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.manifest import MANIFEST
from league.registry.storage.rows import VersionRow

CARD = "README.md"
"""The model card."""


def exported_files(version: VersionRow, artifacts: ArtifactStore) -> dict[str, bytes]:
    """Return name → content of the graphs and probes of all policies, and of `manifest.json`, which is last.

    Raises ArtifactCorrupt if a file differs from the manifest.
    """
    manifest = version.manifest
    names = [name for policy in manifest.policies.values() for name in policy.files]
    return {name: artifacts.read(manifest, name) for name in names} | {MANIFEST: manifest.to_json().encode()}


def write_files(files: Mapping[str, bytes], directory: Path) -> list[Path]:
    """Write files in their order, each completely or not at all, and return them.

    Args:
        files: Name → content.
        directory: Created if it does not exist. Files of these names are replaced.

    Raises:
        ConfigError: `directory` is a file.
        StorageError: A file cannot be written.
    """
    if directory.exists() and not directory.is_dir():
        raise ConfigError(f"{directory}: expected a directory, found a file")
    with disk_errors(directory):
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            with replacing(directory / name) as draft:
                draft.write_bytes(content)
    return [directory / name for name in files]


@contextmanager
def new_folder(directory: Path) -> Iterator[Path]:
    """Yield a folder to write to, which becomes `directory` at the end of the block, unless it raises.

    directory: Must not exist, or be empty.
    Raises ConfigError if `directory` is a file or contains files, and StorageError if a file cannot be written.
    """
    if directory.exists() and not (directory.is_dir() and not any(directory.iterdir())):
        raise ConfigError(f"{directory}: expected a new or empty folder")
    target = directory.absolute()
    with disk_errors(directory):
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as staging:
            draft = Path(staging) / target.name
            draft.mkdir()
            yield draft
            move_durably(draft, target)


def write_folder(files: Mapping[str, bytes], directory: Path) -> list[Path]:
    """Write a new folder with files, completely or not at all, and return their paths. See `new_folder`."""
    with new_folder(directory) as draft:
        for name, content in files.items():
            (draft / name).write_bytes(content)
    return [directory / name for name in files]
