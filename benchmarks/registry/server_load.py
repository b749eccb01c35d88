"""Processor time and connections of a PostgreSQL server, as the kernel and the server count them."""

import os
from pathlib import Path

import psycopg

PROC = Path("/proc")
NAME = "benchmark"
"""Application name of the connection that counts, which is not counted."""


def cpu_seconds(postmaster: int) -> float:
    """Processor time of the server's processes, including those that have ended."""
    pids = [postmaster, *(int(pid) for pid in (PROC / f"{postmaster}/task/{postmaster}/children").read_text().split())]
    fields = (PROC / f"{postmaster}/stat").read_text().rpartition(")")[2].split()
    ended = (int(fields[13]) + int(fields[14])) / os.sysconf("SC_CLK_TCK")
    return ended + sum(_seconds(pid) for pid in pids)


def process_seconds(pid: int) -> float:
    """Processor time of all threads of a process."""
    fields = (PROC / f"{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def connections(socket: Path, user: str) -> int:
    """Number of clients' connections."""
    query = "SELECT count(*) FROM pg_stat_activity WHERE backend_type = 'client backend' AND application_name <> %s"
    with psycopg.connect(f"host={socket} user={user} dbname=postgres application_name={NAME}") as connection:
        row = connection.execute(query, (NAME,)).fetchone()
    assert row is not None
    return int(row[0])


def postmaster(socket: Path) -> int:
    """Process id of the server."""
    return int((socket / "data" / "postmaster.pid").read_text().split()[0])


def on_one_core() -> int:
    """Run this process, and those that it starts from now on, on one core. Returns its number."""
    core = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {core})
    return core


def _seconds(pid: int) -> float:
    try:
        return int((PROC / f"{pid}/schedstat").read_text().split()[0]) / 1e9
    except FileNotFoundError:
        return 0.0
