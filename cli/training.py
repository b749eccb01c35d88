"""`league check-env`, `league train`, `league runs` and `league sweep`: environment checks and training."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer

from cli.options import AsJson, Config, LeagueName, open_registry
from cli.output import console, emit, say, table
from configs import find
from league.errors import ConfigError
from league.refs import CheckpointRef, check_slug, of_league

if TYPE_CHECKING:
    from league.config.league import LeagueConfig
    from league.registry.storage.rows import RunRow, StrengthRow, VersionRow
    from training.sweeps.sweep import SweepReport

INTERRUPTED = 130
"""Exit code of a process ended by SIGINT: 128 + 2."""
TOKENS = {"RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"}

Address = Annotated[
    str | None, typer.Option(help="Running Ray cluster (`auto`, or HOST:PORT). Default: start Ray on this machine.")
]
Cpus = Annotated[int | None, typer.Option(min=1, help="Number of CPUs for the local Ray. Default: all.")]
ObjectStore = Annotated[
    int | None, typer.Option(metavar="MB", help="Size of the local Ray's object store. Default: Ray's own.")
]
Dashboard = Annotated[bool, typer.Option("--dashboard", help="Start the local Ray's dashboard and print its URL.")]
Minutes = Annotated[float | None, typer.Option(help="Maximum training time. Overrides CONFIG.")]
Steps = Annotated[int | None, typer.Option(help="Maximum number of actions of all agents. Overrides CONFIG.")]
Seed = Annotated[int | None, typer.Option(help="Random seed. Overrides CONFIG.")]
Runners = Annotated[int | None, typer.Option(min=0, help="Number of sampling processes. Overrides CONFIG.")]
Gpus = Annotated[float | None, typer.Option(min=0, help="Number of GPUs for the learner. Overrides CONFIG.")]


def check_env(
    config: Config,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes, each played several times.")] = 3,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of steps per episode. Default: play.max_moves.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Test a league's environment against the contract.

    Plays episodes with random legal actions, and checks the scripts, bots and versions that CONFIG names. Exits 1 on a
    violation; notes do not affect the exit code.

    Next step: `league train CONFIG`.
    """
    from league.config.league import LeagueConfig
    from league.environments.conformance.examination import examine
    from league.policies.loading import errors_of_contestants

    league = LeagueConfig.load(find(config))
    found = examine(league, episodes, steps, seed)
    if found.interface is not None:
        for error in errors_of_contestants(league, found.interface, open_registry):
            found.add("fault", str(error))
    if as_json:
        document = asdict(replace(found, interface=None))
        del document["interface"]
        emit(document | {"passed": found.passed})
    else:
        if found.lengths:
            state = "no global state" if found.state_size is None else f"a global state of {found.state_size:,} numbers"
            say(
                f"{league.environment.entry_point}: {found.api}, {found.agents} agents, {state}, episodes of"
                f" {min(found.lengths)} to {max(found.lengths)} steps, {found.steps_per_second:,.0f} steps per second"
            )
            say(found.implementation)
            say(found.policies)
            say(found.actions)
            if (openings := found.openings) is not None:
                say(str(openings))
                if (plies := league.play.opening_plies) != openings.recommended and 0 < plies <= len(openings.lengths):
                    say(f"play.opening_plies is {plies}. {openings.effect(plies)}.")
        if (vectorised := found.vectorised) is not None:
            ratio = vectorised.steps_per_second / vectorised.stock_steps_per_second
            say(
                f"The vectorised and the stock environment reported the same in {vectorised.steps:,} steps. Steps per"
                f" second: {vectorised.steps_per_second:,.0f} with {vectorised.copies:,} copies, stock"
                f" {vectorised.stock_steps_per_second:,.0f} ({ratio:.0f}×)."
            )
        if found.findings:
            rows = [(finding.severity, str(finding)) for finding in found.findings]
            table(("severity", "finding"), rows, prose=("finding",))
        if found.passed:
            say("The environment passes all checks." if not found.findings else "The environment passes, with notes.")
    raise typer.Exit(0 if found.passed else 1)


Parent = Annotated[
    str | None,
    typer.Option("--from", metavar="REF", help="Continue from this version, such as connect_four@3 or @champion."),
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Resume an interrupted run, or a completed one with a larger budget.")
]
Job = Annotated[
    bool, typer.Option("--job", help="Submit a Ray job. --address is the cluster's dashboard, http://HOST:8265.")
]


RoleName = Annotated[
    Literal["main", "exploiter"], typer.Option("--role", help="`exploiter`: a run against one version only.")
]
Against = Annotated[
    str | None,
    typer.Option(metavar="REF", help="The opponent of an exploiter in all episodes, such as connect_four@champion."),
]


def train(
    config: Config,
    parent: Parent = None,
    role: RoleName = "main",
    against: Against = None,
    resume: Resume = False,
    address: Address = None,
    job: Job = False,
    minutes: Minutes = None,
    steps: Steps = None,
    seed: Seed = None,
    runners: Runners = None,
    gpus: Gpus = None,
    cpus: Cpus = None,
    object_store: ObjectStore = None,
    dashboard: Dashboard = False,
) -> None:
    """Train a league's policies and publish versions.

    A version is published at each checkpoint. It contains one ONNX graph per policy, tested for the same actions as the
    trained network. TensorBoard logs are written to LEAGUE_HOME/runs. Ctrl-C publishes the current state and exits;
    `league train CONFIG --resume` continues after an interruption.

    With --role exploiter, the version named by --against is the opponent in all episodes, the settings of
    training.exploiter apply, and the published versions cannot become champion. `--resume --role exploiter` continues
    the newest exploiter's run.

    A job continues when this command exits. Custom environments must be installed on the cluster.

    Next step: `league nightly CONFIG` finds the strongest version and promotes it.
    """
    settings = _without_none(minutes=minutes, steps=steps, seed=seed, runners=runners, gpus=gpus)
    league = _load(config, settings)
    if job:
        options = _without_none(
            **{"from": parent, "role": None if role == "main" else role}, against=against, **settings
        )
        _submit(address, find(config), options, resume, (cpus, object_store, dashboard))
        return
    from evaluation.service.strength_process import strength_process
    from league.ray_cluster import LocalRay
    from training.runs.train import train as run

    registry = open_registry()
    with exit_on_interrupt(), strength_process(registry.storage) as measure:
        published = run(
            league,
            registry=registry,
            parent=_version(parent, league),
            role=role,
            target=_version(against, league),
            resume=resume,
            address=address,
            local=LocalRay(cpus, object_store, dashboard),
            config_path=find(config),
            console=console,
            measure=measure,
        )
    if published:
        say(f"\nPublished {', '.join(version.ref for version in published)}.")
        say(f"Next: {next_step(config, published[-1])}")
    else:
        say("No version was published: the run ended before its first checkpoint.")


def next_step(config: str, version: "VersionRow") -> str:
    """The command that usually follows a run, whose newest version is `version`."""
    if version.exploits is None:
        return f"league nightly {config}   (find the strongest version)"
    return f"league exploitability {version.exploits}   (play its exploiters against it)"


def runs(
    league: LeagueName,
    limit: Annotated[int, typer.Option(min=1, max=1000, help="Maximum number of runs.")] = 20,
    as_json: AsJson = False,
) -> None:
    """List a league's training runs, newest first.

    Shows the role of their versions, their progress, and the last measured scores against the champion and an anchor
    with 95 % intervals (`training.strength`).
    """
    registry = open_registry()
    rows = registry.runs.newest(check_slug("league", league), limit=limit)
    strength = {row.id: _newest_strength(registry.strength.of_run(league, row.id)) for row in rows}
    if as_json:
        emit({"league": league, "runs": [_run_document(row, strength[row.id]) for row in rows]})
        return
    if not rows:
        say(f"{league} has no training runs yet. Start one: league train CONFIG")
        return
    table(
        ("run", "state", "role", "steps", "minutes", "strength"),
        [
            (
                row.id,
                row.state,
                row.role if row.exploits is None else f"{row.role} of @{CheckpointRef.parse(row.exploits).version}",
                row.steps,
                f"{row.seconds / 60:.1f}",
                "; ".join(_score(each, league) for each in strength[row.id]),
            )
            for row in rows
        ],
        prose=("strength",),
        optional=("strength",),
    )


def _newest_strength(rows: "Sequence[StrengthRow]") -> "list[StrengthRow]":
    """The scores of the newest measured version."""
    return [row for row in rows if row.version == rows[-1].version]


def _score(row: "StrengthRow", league: str) -> str:
    opponent = row.opponent.removeprefix(league)
    return f"@{row.version}: {row.score:.0%} [{row.low:.0%}, {row.high:.0%}] against {opponent}"


def _run_document(row: "RunRow", strength: "Sequence[StrengthRow]") -> dict[str, object]:
    names = "state", "role", "exploits", "algorithm", "seed", "steps", "target", "seconds", "parent", "error"
    times = "began_at", "heartbeat_at", "ended_at"
    scores = [asdict(each) for each in strength]
    return {"run": row.id} | {name: getattr(row, name) for name in (*names, *times)} | {"strength": scores}


def sweep(
    config: Config,
    resume: Annotated[bool, typer.Option("--resume", help="Resume an interrupted sweep.")] = False,
    publish: Annotated[bool, typer.Option(help="Publish the last checkpoint of the best trial as a version.")] = True,
    samples: Annotated[
        int | None, typer.Option(min=1, help="Number of samples of the random parameters. Overrides CONFIG.")
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
    """Train with each combination of settings and report the best.

    Runs one trial per combination of the values in CONFIG's `sweep` section. Prints all trials, and the settings of the
    best one as YAML. TensorBoard logs are written to LEAGUE_HOME/sweeps. `league sweep CONFIG --resume` continues after
    an interruption.
    """
    from league.ray_cluster import LocalRay
    from training.sweeps.sweep import sweep as run

    league = _load(config, _without_none(minutes=minutes, steps=steps, seed=seed, runners=runners, gpus=gpus))
    if samples is not None and league.sweep is not None:
        league = league.model_copy(update={"sweep": league.sweep.model_copy(update={"samples": samples})})
    with exit_on_interrupt():
        report = run(
            league,
            registry=open_registry(),
            resume=resume,
            publish_best=publish,
            address=address,
            local=LocalRay(cpus, object_store, dashboard),
            config_path=find(config),
            console=console,
        )
    _show(report, config)
    if not report.is_whole:
        raise typer.Exit(INTERRUPTED)


def _show(report: "SweepReport", config: str) -> None:
    import yaml

    from training.sweeps.search_space import nested

    names = list(report.trials[0].settings)
    table(
        ("trial", *names, "score", "steps", "minutes", "note"),
        [
            (
                trial.number,
                *(str(trial.settings[name]) for name in names),
                trial.score,
                None if trial.outcome is None else trial.outcome.steps,
                None if trial.outcome is None else f"{trial.outcome.seconds / 60:.1f}",
                _note(trial.error, trial.outcome is None, trial.outcome is not None and trial.outcome.ended_early),
            )
            for trial in report.trials
        ],
        prose=("note",),
        optional=("note",),
    )
    say(f"\nPlot the metrics: tensorboard --logdir {report.path}")
    if not report.is_whole:
        say(f"Some trials are incomplete. To continue: league sweep {config} --resume")
    elif report.best is None:
        say("No trial has a score, as none completed an episode. Increase the number of steps.")
    else:
        say(f"Best trial: {report.best.number}. Settings:\n")
        say(yaml.safe_dump({"training": nested(report.best.settings)}, sort_keys=False, default_flow_style=None))
    if report.version is not None:
        say(f"Published as {report.version.ref}.")


def _note(error: Exception | None, is_open: bool, ended_early: bool) -> str:
    if error is not None:
        return str(error)
    return "incomplete" if is_open else "ended early" if ended_early else ""


def _show_token() -> None:
    """Let Ray send the user's token to the dashboard. Ray 2.60 reads this setting when it is imported."""
    if os.environ.keys() & TOKENS or Path("~/.ray/auth_token").expanduser().exists():
        os.environ.setdefault("RAY_AUTH_MODE", "token")


def _submit(
    address: str | None,
    config: Path,
    options: dict[str, object],
    resume: bool,
    local: tuple[int | None, int | None, bool],
) -> None:
    _show_token()
    from league.ray_cluster import LocalRay, check_unlimited
    from league.settings import Storage
    from training.runs.job_submission import submit

    if address is None:
        raise ConfigError("--job requires --address http://HOST:8265, the URL of the cluster's dashboard")
    check_unlimited(LocalRay(*local))
    arguments = [f"--{name}={value}" for name, value in options.items()] + ["--resume"] * resume
    with exit_on_interrupt():
        submit(address, config, arguments, Storage.from_environment(), say)


@contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Turn Ctrl-C into a message and exit code 130. Without a message the process exits at once."""
    try:
        yield
    except KeyboardInterrupt as end:
        if not str(end):
            _exit_at_once()
        say(f"\n{end}")
        raise typer.Exit(INTERRUPTED) from end


def _exit_at_once() -> NoReturn:
    """Exit without stopping threads. Python would end a publishing thread by force, which Ray's handlers report as a
    crash. --resume publishes the version."""
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(INTERRUPTED)


def _load(config: str, settings: dict[str, object]) -> "LeagueConfig":
    from league.config.league import LeagueConfig

    return LeagueConfig.load(find(config)).with_training(**settings)


def _version(ref: str | None, league: "LeagueConfig") -> CheckpointRef | None:
    return None if ref is None else CheckpointRef.parse(of_league(ref, league.league))


def _without_none(**options: object) -> dict[str, object]:
    return {name: value for name, value in options.items() if value is not None}
