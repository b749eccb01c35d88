"""The child processes of a process, by what they run."""

import os
from contextlib import suppress

import psutil


def running_module(module: str, parent: int | None = None) -> list[int]:
    """Return the ids of the children of a process, by default this one, whose command line contains `module`."""
    processes = []
    for child in psutil.Process(parent or os.getpid()).children():
        with suppress(psutil.NoSuchProcess):
            if module in " ".join(child.cmdline()):
                processes.append(child.pid)
    return processes
