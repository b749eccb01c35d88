"""`league nightly`: gate and promotion of new versions, run by a scheduler."""

import sys
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.errors import (
    AlreadyRunning,
    ConfigError,
    LeagueArchived,
    LeagueError,
    UnknownLeague,
    one_line,
)
from league.files import disk_errors
from league.refs import check_slug
from league.settings import Storage
from policy_league.cli.evaluation.report import write_report
from policy_league.cli.interrupt import exit_on_interrupt
from policy_league.cli.main import FAILURE, USAGE_ERROR
from policy_league.cli.options import CORES, AsJson, ClusterWorkers, EvaluationCluster, open_registry, workers_for
from policy_league.cli.output import GameProgress, complain, console, emit, say, show_leaderboard
from policy_league.configs.bundled import find, names

if TYPE_CHECKING:
    from evaluation.gating.nightly import NightlyReport
    from evaluation.gating.trained_exploiters import Trainer
    from league.config.league import LeagueConfig
    from league.registry.registry import Registry
    from league.registry.storage.rows import TrainingNightRow

BUSY = 75
"""EX_TEMPFAIL of sysexits.h: try again later."""


def nightly(
    leagues: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[LEAGUE|CONFIG]…",
            help="Registered leagues, YAML files or bundled configurations. Default: all that are not archived.",
        ),
    ] = None,
    train: Annotated[
        bool,
        typer.Option(
            "--train",
            help="Train from the champion before the tests; after them, train an exploiter of the champion and measure"
            " its score.",
        ),
    ] = False,
    workers: ClusterWorkers = None,
    webhook: Annotated[
        str | None,
        typer.Option(envvar="LEAGUE_WEBHOOK", help="URL to which a summary and the reports are posted as JSON."),
    ] = None,
    address: EvaluationCluster = None,
    as_json: AsJson = False,
) -> None:
    """Test new versions, promote those that pass, and update the ratings.

    Intended for cron, a systemd timer or a CronJob (see deploy/nightly/ in the repository). An interrupted run
    continues when the command is run again, without replaying recorded games. The report of each league is written
    to LEAGUE_HOME/reports.

    If `gate.exploiters` requires it, exploiters are trained against each version that passed all other tests.

    With --train, the section `nightly` of the configuration sets the budget, the opponents and the exploiter's share.

    Exit codes: 0 success, with or without a promotion; 1 a version could not be tested, a league failed, or the
    webhook could not be delivered; 2 invalid arguments, or a league's configuration is invalid; 75 another nightly run
    holds the lock of a league.
    """
    from evaluation.reporting.webhook import deliver

    registry, at_once, outcome = open_registry(), workers_for(workers, address), _Outcome()
    for name in leagues or _registered(registry):
        league = None
        try:
            # Read when its turn comes: other leagues may take hours, in which it may be registered again.
            config = _config(registry, name)
            league = config.league
            _run(config, train, at_once, address, as_json, outcome)
        except LeagueError as error:
            # The remaining leagues are still processed.
            outcome.fail(league, error)
    if as_json:
        documents = {"nights": [night_document(night) for night in outcome.nights]} if train else {}
        emit({"leagues": [report.to_json() for report in outcome.reports], "faults": outcome.errors} | documents)
    if webhook:
        deliver(webhook, [*outcome.summary(), *outcome.errors], outcome.reports)
    if outcome.exit_code:
        sys.exit(outcome.exit_code)


@dataclass(slots=True)
class _Outcome:
    """The results and errors of all leagues."""

    reports: "list[NightlyReport]" = field(default_factory=list)
    nights: "list[TrainingNightRow]" = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    invalid: list[str] = field(default_factory=list)
    busy: bool = False

    @property
    def errors(self) -> list[str]:
        return [*self.faults, *self.invalid]

    @property
    def exit_code(self) -> int:
        return FAILURE if self.faults else USAGE_ERROR if self.invalid else BUSY if self.busy else 0

    def fail(self, league: str | None, error: LeagueError) -> None:
        """Print and record why a league's run ended early. An archived league is not an error.

        league: None if its configuration could not be read, whose error names it.
        """
        sentence = one_line(error) if league is None else f"{league}: {one_line(error)}"
        match error:
            case LeagueArchived():
                complain(f"skipped: {one_line(error)}")
                return
            case AlreadyRunning():
                self.busy = True
            case _ if league is None or isinstance(error, ConfigError):
                self.invalid.append(sentence)
            case _:
                self.faults.append(sentence)
        complain(f"league: {sentence}")

    def summary(self) -> list[str]:
        """Summarise the results, one sentence each."""
        sentences = [sentence for report in self.reports for sentence in summary_of(report)]
        return sentences + [sentence for night in self.nights for sentence in summary_of_night(night)]


def _run(
    config: "LeagueConfig", train: bool, workers: int | None, address: str | None, quiet: bool, outcome: _Outcome
) -> None:
    """Process one league, and add its results and the errors of its steps to `outcome`."""
    from league.ray_cluster import ray_session

    with ray_session(address):
        night, report = run_night(config, workers, quiet, train=train)
    if night is not None:
        outcome.nights.append(night)
        outcome.faults += [f"{config.league}: {fault}" for fault in faults_of(night)]
    if report is not None:
        outcome.reports.append(report)
        outcome.faults += [f"{config.league}: {fault}" for fault in report.faults]


def run_night(
    config: "LeagueConfig", workers: int | None = CORES, quiet: bool = False, *, train: bool = False
) -> "tuple[TrainingNightRow | None, NightlyReport | None]":
    """Run one league's nightly run, print the results, and write the league's report to LEAGUE_HOME/reports.

    Returns:
        The night of training, with `train`; and the report of the gate, unless an earlier process completed it.
    """
    from evaluation.gating.nightly import nightly as run
    from evaluation.gating.training_night import training_night
    from league.ray_cluster import connected

    storage = Storage.from_environment()
    storage.export()
    registry, games, night = open_registry(), GameProgress(quiet), None
    if (trainer := _trainer(registry, games, quiet)) is None and train:
        raise ConfigError(
            "--train requires PyTorch, which is not installed: use the trainer image, or pip install policy-league"
        )
    report: NightlyReport | None
    with ExitStack() as stack:
        if train or config.gate.exploiters.count:
            stack.enter_context(exit_on_interrupt())
            stack.enter_context(connected(None, storage))
        listener = stack.enter_context(games)
        if train and trainer is not None:
            announce = (lambda _: None) if quiet else say
            night, report = training_night(
                config, registry=registry, train=trainer, workers=workers, listener=listener, announce=announce
            )
        else:
            report = run(config, registry=registry, train=trainer, workers=workers, listener=listener)
    for fault in () if night is None else faults_of(night):
        complain(f"{config.league}: {fault}")
    if report is not None:
        _show(report, registry, config, quiet)
    for sentence in () if night is None or quiet else summary_of_night(night):
        say(sentence)
    return night, report


def _show(report: "NightlyReport", registry: "Registry", config: "LeagueConfig", quiet: bool) -> None:
    """Print the results of a nightly run, and write the league's report."""
    from evaluation.reporting.gate_record import why_not_champion

    page = registry.storage.home / "reports" / f"{config.league}.html"
    with disk_errors(page):
        page.parent.mkdir(exist_ok=True)
    write_report(registry, config.league, page)
    for fault in report.faults:
        complain(f"{config.league}: {fault}")
    if not quiet:
        if not report.verdicts:
            has_versions = bool(registry.versions.all(config.league))
            hint = "" if has_versions else " None is published yet: `league train CONFIG` publishes versions."
            say(f"{config.league}: no new versions to test.{hint}")
        say()
        for sentence in summary_of(report):
            say(sentence)
        say()
        show_leaderboard(report.leaderboard, why_not_champion(registry, config.league, report.leaderboard))
        say(f"\nReport: {page}")


def _trainer(registry: "Registry", games: GameProgress, quiet: bool) -> "Trainer | None":
    """Return a function that trains a run and shows its progress in place of that of games, None without PyTorch."""
    if find_spec("torch") is None:
        return None

    def train(config: "LeagueConfig", *, name: str, parent: int | None, target: str | None) -> None:
        from rich.console import Console

        from evaluation.service.strength_process import StrengthProcess
        from league.refs import CheckpointRef
        from training.runs.parent import start_version
        from training.runs.train import train as run

        parent_ref = None if parent is None else CheckpointRef(config.league, parent)
        exploited = None if target is None else CheckpointRef.parse(target)
        start = None if parent_ref is None else start_version(registry, parent_ref, config, exploited)
        if start != parent_ref and exploited is None and not quiet:
            say(f"{parent_ref} was imported and cannot be trained further: training starts from {start or 'scratch'}")
        with games.paused(), closing(StrengthProcess(registry.storage)) as measure:
            run(
                config,
                registry=registry,
                parent=start,
                role="main" if exploited is None else "exploiter",
                target=exploited,
                name=name,
                console=Console(quiet=True) if quiet else console,
                measure=measure,
            )

    return train


def faults_of(night: "TrainingNightRow") -> list[str]:
    """The errors of a night's steps."""
    return [
        f"night {night.number}, {step}: {result['error']}" for step, result in night.steps.items() if "error" in result
    ]


def summary_of_night(night: "TrainingNightRow") -> list[str]:
    """Summarise a night of training: what was trained, and how exploitable the champion is."""
    from evaluation.documents import Difference

    versions = night.steps["train"]["versions"]
    start = "from scratch" if night.start is None else f"from {night.league}@{night.start}"
    sentences = [f"{night.league}: night {night.number} trained {', '.join(versions) or 'no version'} {start}."]
    if (exploitability := night.steps["measure"]["exploitability"]) is not None:
        best = exploitability["exploiters"][0]
        gain = "" if best["gain"] is None else f", return gain {Difference(**best['gain'])}"
        sentences.append(
            f"{exploitability['ref']}: {best['ref']} scores {best['score']:.3f} [{best['low']:.3f}, {best['high']:.3f}]"
            f" against it{gain}. A best response scores at least {exploitability['bound']:.3f}."
        )
    return sentences


def night_document(night: "TrainingNightRow") -> dict[str, Any]:
    """A night of training as JSON."""
    return {
        "league": night.league,
        "night": night.id,
        "number": night.number,
        "parent": night.start,
        "steps": night.steps,
        "began_at": night.began_at,
        "ended_at": night.ended_at,
    }


def summary_of(report: "NightlyReport") -> list[str]:
    """Summarise a nightly run in one sentence per league and confirmed promotion."""
    sentences = [f"{report.league}: {_change(report)}"]
    for gain in report.confirmations:
        low, high = gain.interval
        interval = f"[{'−∞' if low is None else f'{low:+.0f}'}, {'+∞' if high is None else f'{high:+.0f}'}]"
        returns = f", returns {gain.difference}" if gain.difference else ""
        sentences.append(
            f"{gain.candidate} against {gain.opponent} in {gain.games} new games: {gain.elo:+.0f} Elo"
            f" {interval}{returns}."
        )
    return sentences


def _change(report: "NightlyReport") -> str:
    judged = f"{len(report.verdicts)} tested, " if report.verdicts else ""
    if report.champion is None:
        return f"{judged}there is no champion, as no version has passed the gate yet."
    if report.champion == report.champion_before:
        return f"{judged}the champion is still {report.champion}."
    return f"{judged}the champion is now {report.champion} (before: {report.champion_before or 'none'})."


def _registered(registry: "Registry") -> list[str]:
    """The names of all registered leagues."""
    if not (registered := list(registry.leagues.names())):
        say("No league is registered yet. Name a configuration, such as connect_four or a YAML file.")
    return registered


def _config(registry: "Registry", name: str) -> "LeagueConfig":
    """Return the configuration of a registered league, else of a file or a bundled configuration.

    Raises LeagueArchived.
    """
    from league.config.league import LeagueConfig

    if not name.endswith((".yaml", ".yml")):
        try:
            row = registry.leagues.get(check_slug("league", name))
            row.require_active()
            return row.config
        except UnknownLeague as error:
            if name not in names():
                raise UnknownLeague(f"{error}; bundled configurations: {', '.join(names())}") from None
    return LeagueConfig.load(find(name))
