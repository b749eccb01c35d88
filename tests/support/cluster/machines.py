"""Machines on one machine: each has its own address, processes, /tmp and host name, in Linux namespaces.

A machine's processes are children of its first process: killing that one kills all of them at once, as a loss of power
does. The machines are connected by a bridge in a namespace of its own, so that nothing of this machine's network
changes. Everything ends when the process that started it ends.
"""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import DEVNULL, PIPE, STDOUT
from typing import IO, Any

PROGRAMS = ("ip", "unshare", "nsenter", "setpriv", "pgrep")
NETWORK = "10.57.0"
"""Nobody else sees these addresses."""
ROOT = Path(__file__).parents[3]
NAMESPACES = ("--mount", "--net", "--pid", "--uts")
SETUP = """
mount -t proc proc /proc && mount -t tmpfs -o size=512m tmpfs /dev/shm && mount -t tmpfs tmpfs /mnt
for path in "$@"; do mkdir -p "/mnt/${path#/tmp/}" && mount --bind "$path" "/mnt/${path#/tmp/}"; done
mount --move /mnt /tmp && hostname "$NAME" && ip link set lo up && echo ready && exec sleep infinity
"""
"""Start of a machine with an empty /tmp, in which only the folders that all machines share are visible."""


def obstacle() -> str | None:
    """Why there can be no machines here, None if there can."""
    if missing := [name for name in PROGRAMS if shutil.which(name) is None]:
        return f"a cluster needs the program {missing[0]}: install iproute2, util-linux and procps"
    if subprocess.run(["unshare", *NAMESPACES, "--fork", "true"], stderr=DEVNULL).returncode:
        return "a cluster needs network namespaces: run the tests as root, in a container with CAP_SYS_ADMIN"
    return None


class Machine:
    """A machine with an address. `name` is its host name."""

    def __init__(self, name: str, number: int, shared: Sequence[Path], log: Path) -> None:
        self.name = name
        self.address = f"{NETWORK}.{number}"
        self.log = log
        self._number = number
        self._shared = [str(path) for path in (ROOT, Path(sys.prefix), *shared) if path.is_relative_to("/tmp")]
        self.switch: Machine | None = None
        self._first: subprocess.Popen[str] | None = None
        log.touch()

    def boot(self, switch: "Machine | None" = None) -> None:
        """Start the machine, connected to a switch."""
        command = ["setpriv", "--pdeathsig", "KILL", "unshare", *NAMESPACES, "--fork", "--kill-child"]
        self._first = subprocess.Popen(
            [*command, "bash", "-c", SETUP, "setup", *self._shared],
            env=os.environ | {"NAME": self.name},
            stdin=DEVNULL,
            stdout=PIPE,
            text=True,
        )
        assert self._first.stdout is not None
        assert self._first.stdout.readline() == "ready\n", f"{self.name} does not start"
        if switch is not None:
            self.switch = switch
            port = f"port{self._number}"
            switch.link("add", port, "type", "veth", "peer", "name", "eth0", "netns", str(self._pid))
            switch.link("set", port, "master", "bridge", "up")
            self.check_run("ip", "address", "add", f"{self.address}/24", "dev", "eth0")
            self.check_run("ip", "link", "set", "eth0", "up")
            self.check_run("ip", "route", "add", "default", "dev", "eth0")  # Ray finds its address by it

    def kill(self) -> None:
        """End all processes of the machine at once, as a loss of power does."""
        if self._first is not None:
            if self.switch is not None:  # first: the kernel would close the connections of the processes
                self.switch.link("delete", f"port{self._number}", check=False)
            self._first.kill()
            self._first.wait()
            self._first = None

    @contextmanager
    def unplugged(self) -> Iterator[None]:
        """Cut the machine off the network."""
        assert self.switch is not None
        self.switch.link("set", f"port{self._number}", "down")
        try:
            yield
        finally:
            self.switch.link("set", f"port{self._number}", "up")

    def link(self, *arguments: str, check: bool = True) -> None:
        """Change the network's wires. Process ids are those of this machine."""
        subprocess.run(
            ["nsenter", "--target", str(self._pid), "--net", "ip", "link", *arguments], check=check, stderr=DEVNULL
        )

    def start(
        self, *command: str, environment: Mapping[str, str] | None = None, output: IO[Any] | int | None = None
    ) -> "subprocess.Popen[str]":
        """Start a program on the machine. output: by default the machine's log."""
        with self.log.open("a") as log:
            return subprocess.Popen(
                ["nsenter", "--target", str(self._pid), "--mount", "--net", "--pid", "--uts", "--", *command],
                env=os.environ | (environment or {}),
                stdin=DEVNULL,
                stdout=log if output is None else output,
                stderr=STDOUT if output is None else log,
                text=True,
                cwd="/",
            )

    def run(
        self, *command: str, environment: Mapping[str, str] | None = None, timeout: float = 120
    ) -> "subprocess.CompletedProcess[str]":
        """Run a program to its end."""
        process = self.start(*command, environment=environment, output=PIPE)
        try:
            output, _ = process.communicate(timeout=timeout)
        finally:
            end(process, 0)
        return subprocess.CompletedProcess(command, process.returncode, output)

    def check_run(self, *command: str, environment: Mapping[str, str] | None = None, timeout: float = 120) -> str:
        """Run a program that must succeed; returns its output."""
        done = self.run(*command, environment=environment, timeout=timeout)
        assert done.returncode == 0, f"{self.name}: {' '.join(command)}: {done.stdout}\n{self.log.read_text()[-3000:]}"
        return done.stdout

    def runs(self, pattern: str) -> bool:
        """Whether a program runs on the machine whose command line matches."""
        return self.run("pgrep", "--full", pattern).returncode == 0

    @property
    def _pid(self) -> int:
        """The first process of the machine, as this machine numbers it."""
        assert self._first is not None, f"{self.name} is off"
        children = Path(f"/proc/{self._first.pid}/task/{self._first.pid}/children").read_text().split()
        return int(children[0])


@contextmanager
def network(names: Sequence[str], shared: Path) -> Iterator[dict[str, Machine]]:
    """Machines connected to one switch. shared: a folder that all of them see; it receives their logs."""
    switch = Machine("switch", 1, [shared], shared / "switch.log")
    machines = {
        name: Machine(name, number, [shared], shared / f"{name}.log") for number, name in enumerate(names, start=10)
    }
    try:
        switch.boot()
        switch.link("add", "bridge", "type", "bridge")
        switch.link("set", "bridge", "up")
        for machine in machines.values():
            machine.boot(switch)
        yield machines
    finally:
        for machine in (*machines.values(), switch):
            machine.kill()


def end(process: "subprocess.Popen[str]", seconds: float = 20) -> int:
    """Ask a program that `start` has started to end; kills it after `seconds`. nsenter passes on no signals."""
    _signal(process, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        return process.wait(seconds)
    _signal(process, signal.SIGKILL)
    return process.wait()


def _signal(process: "subprocess.Popen[str]", number: signal.Signals) -> None:
    """Send a signal to the child of nsenter, unless it has ended."""
    with suppress(FileNotFoundError, ProcessLookupError):
        for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            os.kill(int(child), number)
