"""File systems for a test: a small one, which it can fill, and one that can only be read."""

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


@contextmanager
def small_disk(directory: Path, megabytes: int = 1) -> Iterator[Path]:
    """Mount a file system in memory, or skip the test without the permission to do so."""
    directory.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(directory)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    if not mounted:
        pytest.skip("a file system cannot be mounted here")
    try:
        yield directory
    finally:
        subprocess.run(["umount", "--lazy", str(directory)], check=True)


@contextmanager
def read_only(directory: Path) -> Iterator[None]:
    """Mount a directory over itself so that it can only be read, or skip the test."""
    commands = [["mount", "--bind", directory, directory], ["mount", "-o", "remount,bind,ro", directory]]
    if any(subprocess.run(command, capture_output=True).returncode for command in commands):
        pytest.skip("a file system cannot be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", directory], check=True)


def fill(directory: Path) -> None:
    """Write until nothing more fits."""
    descriptor = os.open(directory / "ballast", os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    with suppress(OSError):
        while os.write(descriptor, bytes(4096)):
            pass
    os.close(descriptor)
