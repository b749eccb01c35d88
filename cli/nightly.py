"""`league nightly`: gate and promotion of new versions, run by a scheduler."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from cli.options import CORES, AsJson, EvaluationCluster, Workers, open_registry
from cli.output import GameProgress, complain, difference, emit, say, show_leaderboard
from configs import find, names
from league.errors import AlreadyRunning, LeagueError, UnknownLeague, one_line
from league.files import disk_errors
from league.refs import check_slug
from league.settings import Storage

if TYPE_CHECKING:
    from evaluation.results import Confirmation, NightlyReport
    from league.config.league import LeagueConfig
    from league.registry.registry import Registry

FAULTS = 1
BUSY = 75
"""EX_TEMPFAIL of sysexits.h: try again later."""


def nightly(
    leagues: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[LEAGUE|CONFIG]…",
            help="Registered leagues, YAML files or bundled configurations. Default: all registered leagues.",
        ),
    ] = None,
    workers: Workers = CORES,
    webhook: Annotated[
        str | None,
        typer.Option(envvar="LEAGUE_WEBHOOK", help="URL to which a summary and the reports are posted as JSON."),
    ] = None,
    address: EvaluationCluster = None,
    as_json: AsJson = False,
) -> None:
    """Test new versions, promote the best and update the ratings.

    Intended for cron, a systemd timer or a CronJob (see deploy/nightly/ in the repository). An interrupted run
    continues when the command is run again, without replaying recorded games. The report of each league is written
    to LEAGUE_HOME/reports.

    Exit codes: 0 success, with or without a promotion; 1 a version could not be tested, a league failed, or the
    webhook could not be delivered; 2 invalid arguments; 75 another nightly run holds the lock of a league.
    """
    from evaluation.reporting.webhook import deliver
    from league.ray_cluster import ray_session

    configs = _configs(leagues or ())
    reports, faults, busy = [], [], False
    for config in configs:
        try:
            with ray_session(address):
                report = run_nightly(config, workers, quiet=as_json)
        except LeagueError as error:
            # The remaining leagues are still processed.
            sentence = f"{config.league}: {one_line(error)}"
            busy |= isinstance(error, AlreadyRunning)
            faults += [] if isinstance(error, AlreadyRunning) else [sentence]
            complain(f"league: {sentence}")
            continue
        reports.append(report)
        faults += [f"{config.league}: {fault}" for fault in report.faults]
    if as_json:
        emit({"leagues": [report.to_json() for report in reports], "faults": faults})
    summary = [sentence for report in reports for sentence in summary_of(report)]
    if webhook:
        deliver(webhook, [*summary, *faults], reports)
    if faults or busy:
        sys.exit(FAULTS if faults else BUSY)


def run_nightly(config: "LeagueConfig", workers: int = CORES, quiet: bool = False) -> "NightlyReport":
    """Run one league's nightly run, print the results, and write the league's report to LEAGUE_HOME/reports."""
    from evaluation.gating.nightly import nightly as run
    from evaluation.reporting.html_page import write
    from evaluation.reporting.league_report import league_report

    Storage.from_environment().export()
    registry = open_registry()
    with GameProgress(quiet) as listener:
        report = run(config, registry=registry, workers=workers, listener=listener)
    page = registry.storage.home / "reports" / f"{config.league}.html"
    with disk_errors(page):
        page.parent.mkdir(exist_ok=True)
    write(league_report(registry, config.league), page)
    for fault in report.faults:
        complain(f"{config.league}: {fault}")
    if not quiet:
        if not report.verdicts:
            say(f"{config.league}: no new versions to test.")
        say()
        for sentence in summary_of(report):
            say(sentence)
        say()
        show_leaderboard(report.leaderboard)
        say(f"\nReport: {page}")
    return report


def summary_of(report: "NightlyReport") -> list[str]:
    """Summarise a nightly run in one sentence per league and confirmed promotion."""
    return [f"{report.league}: {_change(report)}", *(_gain(gain) for gain in report.confirmations)]


def _change(report: "NightlyReport") -> str:
    judged = f"{len(report.verdicts)} tested, " if report.verdicts else ""
    if report.champion is None:
        return f"{judged}no champion, as no version has beaten script:random yet."
    if report.champion == report.champion_before:
        return f"{judged}the champion is still {report.champion}."
    return f"{judged}the champion is now {report.champion} (before: {report.champion_before or 'none'})."


def _gain(gain: "Confirmation") -> str:
    low, high = (f"{bound:+.0f}" if bound is not None else "∞" for bound in gain.interval)
    returns = f", returns {difference(gain.difference)}" if gain.difference else ""
    return (
        f"{gain.candidate} against {gain.opponent} in {gain.games} new games: {gain.elo:+.0f} Elo [{low}, {high}]"
        f"{returns}."
    )


def _configs(named: Sequence[str]) -> "list[LeagueConfig]":
    """Return the configurations of the named leagues and files; of all registered leagues if none is named."""
    registry = open_registry()
    if not named:
        found = [row.config for row in registry.leagues.all()]
        if not found:
            say("No league is registered yet. Name a configuration, such as connect_four or a YAML file.")
        return found
    return [_config(registry, name) for name in named]


def _config(registry: "Registry", name: str) -> "LeagueConfig":
    """Return the configuration of a registered league, else of a file or a bundled configuration."""
    from league.config.league import LeagueConfig

    if not name.endswith((".yaml", ".yml")):
        try:
            return registry.leagues.get(check_slug("league", name)).config
        except UnknownLeague as error:
            if name not in names():
                raise UnknownLeague(f"{error}; bundled configurations: {', '.join(names())}") from None
    return LeagueConfig.load(find(name))
