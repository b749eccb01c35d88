"""`league nightly`: what a scheduler runs."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from cli.evaluation import CORES, Address, AsJson, Workers, show_standings
from cli.output import complain, emit, say
from cli.watching import difference, watched
from evaluation.report import Confirmation, NightReport
from league.config import LeagueConfig
from league.errors import AlreadyRunning, LeagueError
from league.refs import check_slug
from league.registry.faults import disk_faults
from league.registry.registry import Registry
from league.settings import Storage

FAULTS = 1
BUSY = 75
"""EX_TEMPFAIL of sysexits.h: try again later."""


def nightly(
    leagues: Annotated[
        list[str] | None, typer.Argument(metavar="[LEAGUE|FILE]…", help="Default: all registered leagues.")
    ] = None,
    workers: Workers = CORES,
    webhook: Annotated[
        str | None,
        typer.Option(envvar="LEAGUE_WEBHOOK", help="POST a summary, and the reports as JSON, to this URL at the end."),
    ] = None,
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Judge each new version against the champion and the anchors, promote the better one, and rate everybody.

    May be killed at any point and started again: what was played is in the ledger and is not played twice. Meant for
    cron, a systemd timer or a CronJob (see deploy/nightly/). The page that `league report` makes is left in
    LEAGUE_HOME/reports. Exit code 0: all is well, whoever is champion; 1: a
    version could not be judged, a league failed, or nobody took the webhook; 2: a mistake in what was asked; 75:
    another night is at work on one of the leagues.
    """
    from evaluation.cluster import cluster
    from evaluation.webhook import deliver

    configs = _configs(leagues or ())
    reports, faults, busy = [], [], False
    for config in configs:
        try:
            with cluster(address):
                report = hold_night(config, workers, quiet=as_json)
        except LeagueError as error:
            # The other leagues shall have their night all the same.
            sentence = f"{config.league}: {' '.join(str(error).split())}"
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


def hold_night(config: LeagueConfig, workers: int = CORES, quiet: bool = False) -> NightReport:
    """Hold one league's night, tell of it, and leave the league's page in the home."""
    from evaluation.nightly import nightly as run
    from evaluation.pages.league_report import league_report
    from evaluation.pages.page import write

    Storage.from_environment().export()
    registry = Registry.open()
    with watched(quiet) as listener:
        report = run(config, registry=registry, workers=workers, listener=listener)
    page = registry.storage.home / "reports" / f"{config.league}.html"
    with disk_faults(page):
        page.parent.mkdir(exist_ok=True)
    write(league_report(registry, config.league), page)
    for fault in report.faults:
        complain(f"{config.league}: {fault}")
    if not quiet:
        if not report.verdicts:
            say(f"{config.league}: no new version to judge.")
        say()
        for sentence in summary_of(report):
            say(sentence)
        say()
        show_standings(report.standings)
        say(f"\nMore on {page}")
    return report


def summary_of(report: NightReport) -> list[str]:
    """What a person wants to know of a night in the morning."""
    return [f"{report.league}: {_change(report)}", *(_gain(gain) for gain in report.confirmations)]


def _change(report: NightReport) -> str:
    judged = f"{len(report.verdicts)} judged, " if report.verdicts else ""
    if report.champion is None:
        return f"{judged}no version has beaten script:random yet, so there is no champion."
    if report.champion == report.champion_before:
        return f"{judged}the champion is still {report.champion}."
    return f"{judged}the champion is now {report.champion} (before: {report.champion_before or 'none'})."


def _gain(gain: Confirmation) -> str:
    low, high = (f"{bound:+.0f}" if bound is not None else "∞" for bound in gain.interval)
    returns = f", returns {difference(gain.difference)}" if gain.difference else ""
    return (
        f"{gain.candidate} against {gain.opponent} in {gain.games} fresh games: {gain.elo:+.0f} Elo [{low}, {high}]"
        f"{returns}."
    )


def _configs(named: list[str] | tuple[str, ...]) -> list[LeagueConfig]:
    """Of files and of registered leagues; of all that are registered if none is named."""
    registry = Registry.open()
    if not named:
        found = [row.config for row in registry.leagues()]
        if not found:
            say("No league is registered yet: name a file, such as configs/connect_four.yaml.")
        return found
    return [
        LeagueConfig.load(Path(name))
        if name.endswith((".yaml", ".yml"))
        else registry.league(check_slug("league", name)).config
        for name in named
    ]
