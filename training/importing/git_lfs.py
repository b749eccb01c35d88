"""Names files whose content Git LFS has not fetched: in a clone without it, they are short texts that point to it."""

from pathlib import Path

from league.errors import ConfigError

POINTER = b"version https://git-lfs.github.com/spec/"
"""Beginning of a pointer, see https://github.com/git-lfs/git-lfs/blob/main/docs/spec.md."""


def require_content(path: Path) -> None:
    """Raise ConfigError if a file is a pointer. Other problems are left to who reads it."""
    if path.is_file():
        with path.open("rb") as file:
            if file.read(len(POINTER)) == POINTER:
                raise ConfigError(f"{path} is a Git LFS pointer, not the file itself: run `git lfs pull`")
