"""Start-up time of the command line: `league --help`, and `league versions` of a league without games.

    python -m benchmarks.startup [--against CHECKOUT] [--quick]

Prints the minimum wall and CPU time of 10 runs (--quick: 3), so that other processes affect it little. With --against,
runs alternate between this code and another checkout with the same dependencies, each with a home of its own.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

HERE = Path(__file__).parents[1]
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


def main() -> None:
    repeats = 3 if "--quick" in sys.argv else 10
    checkouts = [HERE]
    if "--against" in sys.argv:
        checkouts.append(Path(sys.argv[sys.argv.index("--against") + 1]))
    with tempfile.TemporaryDirectory() as directory:
        environments = [_environment(checkout, Path(directory) / str(i)) for i, checkout in enumerate(checkouts)]
        for arguments, target in TARGETS.items():
            runs = [[_run(arguments, each) for each in environments] for _ in range(repeats)]
            best = [[min(times) for times in zip(*of_checkout, strict=True)] for of_checkout in zip(*runs, strict=True)]
            shown = [f"{wall:.2f} s, CPU {cpu:.2f} s" for wall, cpu in best]
            print(f"league {arguments}: {' against '.join(shown)} (target: {target} s)")


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


if __name__ == "__main__":
    main()
