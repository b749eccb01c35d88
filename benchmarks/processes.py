"""The server processes that a benchmark has started."""

from pathlib import Path

import psutil


def haproxy_processes() -> set[int]:
    """Ids of the HAProxy processes below this process."""
    return {process.pid for process in _below() if _name(process) == "haproxy"}


def replica_processes(home: Path | None = None) -> list[psutil.Process]:
    """The replicas of Ray Serve below this process. home: only those of the server with this LEAGUE_HOME."""
    return [process for process in _below() if _is_replica(process) and (home is None or _home(process) == str(home))]


def _below() -> list[psutil.Process]:
    return psutil.Process().children(recursive=True)


def _is_replica(process: psutil.Process) -> bool:
    try:
        return "PolicyServer" in process.cmdline()[0]
    except (psutil.NoSuchProcess, IndexError):
        return False


def _home(process: psutil.Process) -> str | None:
    try:
        return process.environ().get("LEAGUE_HOME")
    except psutil.NoSuchProcess:
        return None


def _name(process: psutil.Process) -> str:
    try:
        return process.name()
    except psutil.NoSuchProcess:
        return ""
