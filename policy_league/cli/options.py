"""Arguments and options that several commands share, and the registry that they work on."""

import gc
import getpass
import os
from functools import cache
from typing import TYPE_CHECKING, Annotated

import typer

from league.ray_cluster import usable_cpus

if TYPE_CHECKING:
    from league.registry.registry import Registry

CORES = usable_cpus()
MAX_SEED = 2**63 - 1
DEFAULT_URL = "http://127.0.0.1:8000"
"""URL of the policy server that `league serve` starts and `league act` calls."""

Config = Annotated[
    str,
    typer.Argument(metavar="CONFIG", help="YAML file, or name of a bundled configuration such as connect_four."),
]
LeagueName = Annotated[str, typer.Argument(metavar="LEAGUE", help="Name of the league, such as connect_four.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")]
Reason = Annotated[str, typer.Option(help="Reason, recorded in the history.")]
Actor = Annotated[
    str | None, typer.Option(help="Name recorded in the history. Default: the current user of this machine.")
]
Timeout = Annotated[float, typer.Option(min=0, help="Maximum time for --wait, in seconds.")]
Workers = Annotated[
    int, typer.Option(min=0, help="Number of Ray tasks that play games in parallel; 0 plays in this process.")
]
UNNAMED = "uid "
"""What precedes the number of a user without a name."""
DEFAULT_SECONDS = 60.0
Seconds = Annotated[
    float,
    typer.Option(min=1, help="Seconds after which the checks of a slow environment are cut short, which is reported."),
]
ClusterWorkers = Annotated[
    int | None,
    typer.Option(
        min=0,
        help="Number of Ray tasks that play games in parallel; 0 plays in this process. Default: one per CPU, with "
        "--address of the cluster, also of nodes that join.",
    ),
]
EvaluationCluster = Annotated[
    str | None,
    typer.Option(metavar="HOST:PORT", help="Ray cluster to play on; `auto` selects the one running on this machine."),
]


def workers_for(workers: int | None, address: str | None) -> int | None:
    """Return the number of workers: by default the CPUs of this machine, or on a cluster None, all that it has."""
    return CORES if workers is None and address is None else workers


def acting(actor: str | None) -> str:
    """Return who acts: `actor`, or the current user, by number if it has no name, as in some containers."""
    try:
        return actor or getpass.getuser()
    except (KeyError, OSError):
        return f"{UNNAMED}{os.getuid()}"


def open_registry(create: bool = True) -> "Registry":
    """Open the registry of the environment variables. Imports SQLAlchemy.

    create: create an SQLite database that does not exist.
    """
    return _registry_class().open(create=create)


@cache
def _registry_class() -> "type[Registry]":
    gc.disable()  # What is imported stays until the end. Searching it for garbage takes 0.1 s.
    from league.registry.registry import Registry

    gc.freeze()
    gc.enable()
    return Registry
