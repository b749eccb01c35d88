"""The server processes that a benchmark has started."""

import psutil


def haproxy_processes() -> set[int]:
    """Ids of the HAProxy processes below this process."""
    return {process.pid for process in _below() if _name(process) == "haproxy"}


def replica_processes() -> list[psutil.Process]:
    """The replicas of Ray Serve below this process."""
    return [process for process in _below() if _is_replica(process)]


def _below() -> list[psutil.Process]:
    return psutil.Process().children(recursive=True)


def _is_replica(process: psutil.Process) -> bool:
    try:
        return "PolicyServer" in process.cmdline()[0]
    except (psutil.NoSuchProcess, IndexError):
        return False


def _name(process: psutil.Process) -> str:
    try:
        return process.name()
    except psutil.NoSuchProcess:
        return ""
