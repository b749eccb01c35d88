"""`league train` and `league sweep`."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
import yaml

from cli.output import console, say, table
from league.config import LeagueConfig
from league.errors import ConfigError

if TYPE_CHECKING:
    from training.sweep import SweepReport

INTERRUPTED = 130
"""128 + SIGINT."""
TOKENS = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}

Config = Annotated[Path, typer.Argument(help="The league's file, such as configs/connect_four.yaml.")]
Address = Annotated[
    str | None, typer.Option(help="A running Ray cluster (`auto`, or host:port). Default: a local Ray.")
]
Cpus = Annotated[int | None, typer.Option(min=1, help="CPUs that the local Ray may use. Default: all.")]
ObjectStore = Annotated[
    int | None, typer.Option(metavar="MB", help="Shared memory of the local Ray's object store. Default: as Ray does.")
]
Dashboard = Annotated[bool, typer.Option("--dashboard", help="Start the local Ray's dashboard, and say where it is.")]
Minutes = Annotated[float | None, typer.Option(help="Stop training after this long, instead of what CONFIG says.")]
Steps = Annotated[int | None, typer.Option(help="Stop after this many actions, instead of what CONFIG says.")]
Seed = Annotated[int | None, typer.Option(help="Another seed than CONFIG's.")]
Runners = Annotated[int | None, typer.Option(min=0, help="Sampling processes, instead of what CONFIG says.")]
Gpus = Annotated[float | None, typer.Option(min=0, help="GPUs of the learner, instead of what CONFIG says.")]


def train(
    config: Config,
    parent: Annotated[
        str | None,
        typer.Option("--from", metavar="REF", help="Train on from this version, e.g. connect_four@3 or @champion."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run that was interrupted, or with a larger budget.")
    ] = False,
    address: Address = None,
    job: Annotated[
        bool,
        typer.Option("--job", help="Run this as a Ray job: --address is the cluster's dashboard, http://HOST:8265."),
    ] = False,
    minutes: Minutes = None,
    steps: Steps = None,
    seed: Seed = None,
    runners: Runners = None,
    gpus: Gpus = None,
    cpus: Cpus = None,
    object_store: ObjectStore = None,
    dashboard: Dashboard = False,
) -> None:
    """Train a league's policies and publish a version at each checkpoint.

    Each version holds one ONNX graph per policy, proven to act as the trained network does. Curves are written for
    TensorBoard below LEAGUE_HOME/runs. Ctrl-C publishes what there is and ends; after that, or after any other end
    that was none, `league train CONFIG --resume` goes on.

    As a job, training goes on when this command ends; an environment of your own must be installed on the cluster.

    Next: `league nightly CONFIG` finds out which version is the strongest, and promotes it.
    """
    settings = _given(minutes=minutes, steps=steps, seed=seed, runners=runners, gpus=gpus)
    league = LeagueConfig.load(config).with_training(**settings)
    if job:
        _show_token()
    from training.cluster import LocalRay, check_unlimited

    local = LocalRay(cpus, object_store, dashboard)
    if job:
        if address is None:
            raise ConfigError("--job needs --address http://HOST:8265, the address of the cluster's dashboard")
        check_unlimited(local)
        options = _given(**{"from": parent}, **settings)
        _submit(address, config, [f"--{name}={value}" for name, value in options.items()] + ["--resume"] * resume)
        return
    from league.refs import CheckpointRef, of_league
    from league.registry.registry import Registry
    from training.run import train as run

    with _ended_by_ctrl_c():
        published = run(
            league,
            registry=Registry.open(),
            parent=None if parent is None else CheckpointRef.parse(of_league(parent, league.league)),
            resume=resume,
            address=address,
            local=local,
            config_path=config,
            console=console,
        )
    if not published:
        say("Nothing was published: the run ended before its first checkpoint.")
        return
    say(f"\nPublished {', '.join(version.ref for version in published)}.")
    say(f"Next: league nightly {config}   (who is the strongest?)")


def sweep(
    config: Config,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the sweep that was interrupted.")] = False,
    publish: Annotated[bool, typer.Option(help="Publish the best trial's last checkpoint as a version.")] = True,
    samples: Annotated[
        int | None, typer.Option(min=1, help="Draws of the random parameters, instead of what CONFIG says.")
    ] = None,
    address: Address = None,
    minutes: Minutes = None,
    steps: Steps = None,
    seed: Seed = None,
    runners: Runners = None,
    gpus: Gpus = None,
    cpus: Cpus = None,
    object_store: ObjectStore = None,
    dashboard: Dashboard = False,
) -> None:
    """Train once for each combination of settings that CONFIG's `sweep` names, and find the best.

    Prints all trials, and the best one's settings as they are written in the league's file. Curves of each trial are
    written for TensorBoard below LEAGUE_HOME/sweeps. Killed in the middle? `league sweep CONFIG --resume` goes on.
    """
    league = LeagueConfig.load(config)
    league = league.with_training(**_given(minutes=minutes, steps=steps, seed=seed, runners=runners, gpus=gpus))
    if samples is not None and league.sweep is not None:
        league = league.model_copy(update={"sweep": league.sweep.model_copy(update={"samples": samples})})
    from league.registry.registry import Registry
    from training.cluster import LocalRay
    from training.sweep import sweep as run

    with _ended_by_ctrl_c():
        report = run(
            league,
            registry=Registry.open(),
            resume=resume,
            publish_best=publish,
            address=address,
            local=LocalRay(cpus, object_store, dashboard),
            config_path=config,
            console=console,
        )
    _tell(report, config)
    if not report.is_whole:
        raise typer.Exit(INTERRUPTED)


def _tell(report: "SweepReport", config: Path) -> None:
    from training.search import nested

    names = list(report.trials[0].settings)
    table(
        ("trial", *names, "score", "steps", "minutes", ""),
        [
            (
                trial.number,
                *(str(trial.settings[name]) for name in names),
                trial.score,
                None if trial.outcome is None else trial.outcome.steps,
                None if trial.outcome is None else round(trial.outcome.seconds / 60, 1),
                _note(trial.error, trial.outcome is None, trial.outcome is not None and trial.outcome.ended_early),
            )
            for trial in report.trials
        ],
    )
    say(f"\nCurves: tensorboard --logdir {report.path}")
    if not report.is_whole:
        say(f"Not all trials are over. To go on: league sweep {config} --resume")
    elif report.best is None:
        say("No trial has a score: none finished an episode. Give them more steps.")
    else:
        say(f"Trial {report.best.number} is the best. Its settings:\n")
        say(yaml.safe_dump({"training": nested(report.best.settings)}, sort_keys=False, default_flow_style=None))
    if report.version is not None:
        say(f"Published it as {report.version.ref}.")


def _note(error: Exception | None, is_open: bool, ended_early: bool) -> str:
    if error is not None:
        return str(error)
    return "not over" if is_open else "ended early" if ended_early else ""


def _show_token() -> None:
    """Ray 2.60 asks for a token at each dashboard by default, but shows the one that this user has only if it was told
    to before it was imported."""
    if os.environ.keys() & TOKENS or Path("~/.ray/auth_token").expanduser().exists():
        os.environ.setdefault("RAY_AUTH_MODE", "token")


def _submit(address: str, config: Path, arguments: list[str]) -> None:
    from league.settings import Storage
    from training.job import submit

    with _ended_by_ctrl_c():
        submit(address, config, arguments, Storage.from_environment(), say)


@contextmanager
def _ended_by_ctrl_c() -> Iterator[None]:
    """Ctrl-C is no fault: say what there is to say, and end. What says nothing ends at once."""
    try:
        yield
    except KeyboardInterrupt as end:
        if not str(end):
            _end_at_once()
        say(f"\n{end}")
        raise typer.Exit(INTERRUPTED) from end


def _end_at_once() -> NoReturn:
    """A version may be in the making on a thread of its own. Python would end that thread by force, below Ray's
    handlers, which take that for a crash. Nothing is lost: --resume publishes it."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(INTERRUPTED)


def _given(**options: object) -> dict[str, object]:
    return {name: value for name, value in options.items() if value is not None}
