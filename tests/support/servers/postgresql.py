"""A temporary PostgreSQL server on a Unix socket, if its programs are installed."""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import DEVNULL

import psycopg

USER = "league"


def programs() -> Path | None:
    """The directory of initdb and pg_ctl."""
    program = shutil.which("initdb")
    installed = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return Path(program).parent if program else installed[-1].parent if installed else None


@contextmanager
def server(binaries: Path, max_connections: int = 100) -> Iterator[Path]:
    """Run a server; yields the directory of its socket. PostgreSQL does not run as root: root switches to another
    account, and not in a fork of this process (`user=` of subprocess): it has threads, and one such fork was aborted.
    """
    account, switch = _account(), []
    with tempfile.TemporaryDirectory(prefix="pg") as name:
        home = Path(name)
        if account:
            shutil.chown(home, account)
            switch = ["setpriv", f"--reuid={account}", f"--regid={pwd.getpwnam(account).pw_gid}", "--init-groups"]
        data = str(home / "data")
        initdb = [str(binaries / "initdb"), "-D", data, "-U", USER, "-A", "trust", "-E", "UTF8", "--no-sync"]
        done = subprocess.run([*switch, *initdb], cwd=home, stdin=DEVNULL, capture_output=True, text=True)
        assert done.returncode == 0, f"{done.returncode}: {done.stdout}{done.stderr}"
        options = ["-k", name, "-c", "listen_addresses=", "-c", "fsync=off", "-c", f"max_connections={max_connections}"]
        command = [*switch, str(binaries / "postgres"), "-D", data, *options]
        process = subprocess.Popen(command, cwd=home, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL)
        try:
            _wait(home, process)
            yield home
        finally:
            process.send_signal(signal.SIGQUIT)
            process.wait()


def create(socket: Path, schema: str) -> str:
    """Create an empty schema, which is cheaper than a database; returns a URL that sees only this schema."""
    with _connect(socket) as connection:
        connection.execute(f'CREATE SCHEMA "{schema}"')
    return f"postgresql://{USER}@/postgres?host={socket}&options=-csearch_path%3D{schema}"


def _connect(socket: Path) -> psycopg.Connection:
    return psycopg.connect(f"host={socket} user={USER} dbname=postgres", autocommit=True)


def _wait(socket: Path, process: subprocess.Popen[bytes], seconds: float = 30) -> None:
    deadline = time.monotonic() + seconds
    while True:
        try:
            _connect(socket).close()
        except psycopg.OperationalError:
            if process.poll() is not None or time.monotonic() > deadline:
                raise
        else:
            return


def _account() -> str | None:
    if os.geteuid() != 0:
        return None
    names = {entry.pw_name for entry in pwd.getpwall()}
    return "postgres" if "postgres" in names else "nobody"
