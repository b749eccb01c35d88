"""Digests of a checkpoint that is not published yet: RLlib unpickles it, so it is verified before it is read.

The digests are beside the files: they detect damage, and no one who can write to the directory.
"""

import json
import shutil
from pathlib import Path, PurePosixPath

from pydantic import TypeAdapter, ValidationError

from league.errors import ArtifactCorrupt
from league.files import copy_verified, digests_of, disk_errors, files_in

DIGESTS_FILE = "digests.json"
"""In a checkpoint: relative path → SHA-256 of every other file."""


def write_digests(checkpoint: Path) -> None:
    """Record the digests of all files of a new checkpoint."""
    digests = digests_of(checkpoint, files_in(checkpoint))
    (checkpoint / DIGESTS_FILE).write_text(json.dumps(digests, indent=2))


def private_copy(checkpoint: Path, target: Path) -> Path:
    """Copy a checkpoint to the private directory `target`, which is replaced if it exists, and verify the copy.

    Returns `target`. Raises ArtifactCorrupt if a file is missing or was changed.
    """
    path = checkpoint / DIGESTS_FILE
    with disk_errors(path):
        content = path.read_bytes()
    try:
        recorded = TypeAdapter(dict[str, str]).validate_json(content)
    except ValidationError as error:
        raise ArtifactCorrupt(f"{path}: {error.errors()[0]['msg']}") from error
    for name in recorded:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ArtifactCorrupt(f"{path}: {name!r}: expected a path inside the checkpoint")
    shutil.rmtree(target, ignore_errors=True)
    copy_verified(checkpoint, recorded, target, str(checkpoint))
    return target
