"""Start-up time of the command line: `league --help`, and `league versions` of a league without games.

The minimum of the wall times of 10 runs, and that of the CPU times, so that other processes affect them little. With
--against, runs alternate between this code and another checkout with the same dependencies, each with its own home.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.harness import ROOT, Quick, Target

TARGETS = {"--help": 0.25, "versions rps": 0.6}
"""Seconds on an idle core."""
COMMAND = [sys.executable, "-c", "import sys; from policy_league.cli.main import run; sys.exit(run())"]
REGISTER = """
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.registry.registry import Registry
from league.settings import Storage
import sys
config = LeagueConfig.load(sys.argv[1])
registry = Registry.open(Storage.at(sys.argv[2]))
# Older revisions have `Registry.register`.
register = getattr(registry, "register", None) or registry.leagues.register
register(config, interface(config))
"""


def main(
    quick: Quick = False, against: Annotated[Path | None, typer.Option(help="another checkout")] = None
) -> Iterator[Target]:
    """Time both commands."""
    with tempfile.TemporaryDirectory() as directory:
        checkouts = [ROOT, *([against] if against else [])]
        environments = [_environment(checkout, Path(directory) / str(i)) for i, checkout in enumerate(checkouts)]
        for arguments, limit in TARGETS.items():
            runs = [[_run(arguments, environment) for environment in environments] for _ in range(3 if quick else 10)]
            (wall, cpu), *other = (
                [min(times) for times in zip(*checkout, strict=True)] for checkout in zip(*runs, strict=True)
            )
            note = f"CPU {cpu:.2f} s" + "".join(f"; {against}: {wall:.2f} s, CPU {cpu:.2f} s" for wall, cpu in other)
            yield Target(f"league {arguments}", round(wall, 3), "s", at_most=limit, note=note)


def _environment(checkout: Path, home: Path) -> dict[str, str]:
    """Environment variables of a checkout with a registered league."""
    # Both use compiled modules, whatever the caller has set.
    shared = {"PYTHONDONTWRITEBYTECODE": ""}
    environment = os.environ | shared | {"PYTHONPATH": str(checkout), "LEAGUE_HOME": str(home)}
    register = [sys.executable, "-c", REGISTER, str(checkout / "policy_league/configs/rps.yaml"), str(home)]
    subprocess.run(register, env=environment, cwd=checkout, check=True)
    return environment


def _run(arguments: str, environment: Mapping[str, str]) -> tuple[float, float]:
    """Return wall and CPU seconds of one run."""
    command = [*COMMAND, *arguments.split()]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, env=environment, cwd="/", check=True, stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
