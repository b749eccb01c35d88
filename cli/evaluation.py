"""`league evaluate`, `league nightly` and `league verify`."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cli.output import console, elo, emit, errors, say, table
from evaluation.report import Difference, EvaluationReport, Listener, NightReport, Standing, VerdictReport
from evaluation.report import Progress as Games
from league.config import LeagueConfig
from league.refs import check_slug
from league.registry.registry import Registry
from league.settings import Storage

CORES = os.cpu_count() or 1

Workers = Annotated[int, typer.Option(min=0, help="Ray tasks that play at once; 0 plays in this process.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of tables.")]


def evaluate(
    league: Annotated[str, typer.Argument(metavar="LEAGUE", help="The league's name, such as connect_four.")],
    refs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[REF]…", help="Who plays, e.g. connect_four@3. Default: all versions."),
    ] = None,
    blocks: Annotated[
        int, typer.Option(min=1, help="Matches of each pair; a match is two games from one seed, places changed.")
    ] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Another one plays fresh games.")] = 0,
    workers: Workers = CORES,
    as_json: AsJson = False,
) -> None:
    """Play a round robin and show who stands where. The scripts `random` and `one_ply` take part where they can.

    Nothing is promoted: that is what `league nightly` and `league promote` do. All matches count for the ratings.
    """
    from evaluation.tournament import evaluate as run

    Storage.from_environment().export()
    with _shown(quiet=as_json) as listener:
        report = run(
            check_slug("league", league),
            refs or (),
            registry=Registry.open(),
            blocks=blocks,
            workers=workers,
            seed=seed,
            listener=listener,
        )
    if as_json:
        emit(report.to_json())
        return
    say(f"{league}: {report.games} games, {report.distinct_games} of them different\n")
    _show_standings(report.standings)
    for side, standings in report.by_side.items():
        say(f"\nAs {side}:")
        _show_standings(standings)
    _show_payoff(report)
    for ref, lost in report.forfeits.items():
        errors.print(f"{ref} forfeited {lost} games: it had no legal action to give", markup=False, soft_wrap=True)


def nightly(
    configs: Annotated[list[Path], typer.Argument(metavar="CONFIG…", help="The leagues' files.")],
    workers: Workers = CORES,
    as_json: AsJson = False,
) -> None:
    """Judge each new version against the champion, promote the better one, and rate everybody.

    May be killed at any point and started again: what was played is in the ledger and is not played twice.
    Run it from cron every night; a second one beside it is refused.
    """
    leagues = [LeagueConfig.load(path) for path in configs]
    reports = [hold_night(config, workers, quiet=as_json) for config in leagues]
    if as_json:
        emit({"leagues": [report.to_json() for report in reports]})


def verify(
    verdict: Annotated[str, typer.Argument(metavar="VERDICT", help="Its id, which `league history` and --json tell.")],
    replays: Annotated[int, typer.Option(min=0, help="Games that are played again from their seeds, too.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Compute a verdict again from the games in the ledger, and fail if its record says anything else."""
    from evaluation.verification import verify as run

    found = run(verdict, registry=Registry.open(), replays=replays)
    if as_json:
        emit(found.to_json())
        return
    say(f"{found.outcome}: {found.matches} matches are as scheduled, and {found.numbers} numbers follow from them.")
    if found.replayed:
        say(f"{found.replayed} games were played again and came out the same.")


def hold_night(config: LeagueConfig, workers: int = CORES, quiet: bool = False) -> NightReport:
    """Hold one league's night and tell of it."""
    from evaluation.nightly import nightly as run

    Storage.from_environment().export()
    with _shown(quiet) as listener:
        report = run(config, registry=Registry.open(), workers=workers, listener=listener)
    for fault in report.faults:
        errors.print(f"{config.league}: {fault}", markup=False, soft_wrap=True)
    if not quiet:
        if not report.verdicts:
            say(f"{config.league}: no new version to judge.")
        say(f"\n{config.league}: {_change(report)}\n")
        _show_standings(report.standings)
    return report


def _change(report: NightReport) -> str:
    if report.champion is None:
        return "no version has beaten script:random yet, so there is no champion."
    if report.champion == report.champion_before:
        return f"the champion is still {report.champion}."
    return f"the champion is now {report.champion} (before: {report.champion_before or 'none'})."


def _show_standings(standings: tuple[Standing, ...]) -> None:
    table(
        ("contestant", "rating [95 %]", "score", "mean return", "games"),
        [
            (
                standing.ref,
                elo(standing.rating, standing.interval),
                standing.score,
                standing.mean_return,
                standing.games,
            )
            for standing in standings
        ],
    )


def _show_payoff(report: EvaluationReport) -> None:
    payoff = report.payoff
    names = [_short(ref) for ref in payoff.contestants]
    compared = "" if report.scoring == "game" else ", compared on the same side of the same seed"
    say(f"\nScore of the row against the column{compared} (1 wins always, 0.5 is even):")
    table(("", *names), [(name, *row) for name, row in zip(names, payoff.score, strict=True)])
    if report.scoring == "side":
        say("\nMean return of the row minus that of the column in the same blocks [95 %]:")
        cells = [[None if gap is None else _difference(gap) for gap in row] for row in payoff.difference]
        table(("", *names), [(name, *row) for name, row in zip(names, cells, strict=True)])


def _difference(gap: Difference) -> str:
    """`+1.5 [0.9, 2.1]`"""
    span = "" if gap.low is None or gap.high is None else f" [{gap.low:.4g}, {gap.high:.4g}]"
    return f"{gap.mean:+.4g}{span}"


def _verdict(report: VerdictReport) -> str:
    """`connect_four@2 against connect_four@1: promote after 40 games, score 0.71 (LLR 2.97 ≥ 2.94)`"""
    score = "–" if report.score is None else f"{report.score:.3f}"
    low, high = report.bounds
    place = f"LLR {report.llr:+.2f} in [{low:+.2f}, {high:+.2f}]"
    note = f": {report.note}" if report.note else ""
    games = f"after {report.games} games ({report.distinct_games} different), score {score}, {place}"
    if report.difference:
        games += f", returns differ by {_difference(report.difference)}"
    return f"{report.candidate} against {report.opponent}: {report.outcome} {games}{note}"


def _short(ref: str) -> str:
    return ref.rpartition("@")[2] if "@" in ref else ref


class _shown:  # noqa: N801  reads as a phrase where it is used
    """Progress of games: a live bar in a terminal; elsewhere, and for verdicts, plain lines."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("", total=None, note="")

    def __enter__(self) -> Listener:
        self._bar.start()
        return self._tell

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _tell(self, event: Games | VerdictReport) -> None:
        if self._quiet:
            return
        if isinstance(event, VerdictReport):
            console.print(f"  {_verdict(event)}", markup=False, soft_wrap=True)
            return
        note = "" if event.llr is None else f"LLR {event.llr:+.2f}"
        self._bar.update(self._task, description=event.what, completed=event.played, total=event.of, note=note)
