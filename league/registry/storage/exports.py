"""Writes the files of a version for use in other programs: graphs, probes and the manifest."""

from pathlib import Path

from league.errors import ConfigError
from league.files import disk_errors, replacing
from league.registry.storage.artifacts import ArtifactStore
from league.registry.storage.manifest import MANIFEST
from league.registry.storage.rows import VersionRow


def export_version(version: VersionRow, artifacts: ArtifactStore, directory: Path) -> list[Path]:
    """Write the graphs and probes of all policies, and `manifest.json` last.

    Args:
        version: The version.
        artifacts: Where its files are.
        directory: Created if it does not exist. Files of an earlier export are replaced.

    Returns:
        The files that were written.

    Raises:
        ConfigError: `directory` is a file.
        ArtifactCorrupt: A file differs from the manifest.
        StorageError: A file cannot be written.
    """
    if directory.exists() and not directory.is_dir():
        raise ConfigError(f"{directory}: expected a directory, found a file")
    manifest = version.manifest
    names = [name for policy in manifest.policies.values() for name in (policy.file, policy.probes) if name]
    contents = {name: artifacts.read(manifest, name) for name in names}
    contents[MANIFEST] = manifest.to_json().encode()
    written = []
    with disk_errors(directory):
        directory.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            with replacing(directory / name) as draft:
                draft.write_bytes(content)
            written.append(directory / name)
    return written
