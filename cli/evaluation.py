"""`league evaluate`, `league nightly` and `league verify`."""

import os
from collections.abc import Sequence
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cli.output import console, elo, emit, errors, say, table
from evaluation.report import (
    CrossPlay,
    Difference,
    Estimate,
    EvaluationReport,
    Listener,
    NightReport,
    Population,
    Standing,
    VerdictReport,
)
from evaluation.report import Progress as Games
from league.config import LeagueConfig
from league.refs import check_slug
from league.registry.registry import Registry
from league.settings import Storage

CORES = os.cpu_count() or 1


class Schedule(Enum):
    """What `league evaluate` can play."""

    round_robin = "round_robin"
    gauntlet = "gauntlet"
    adaptive = "adaptive"
    cross_play = "cross_play"


Workers = Annotated[int, typer.Option(min=0, help="Ray tasks that play at once; 0 plays in this process.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of tables.")]


def evaluate(
    league: Annotated[str, typer.Argument(metavar="LEAGUE", help="The league's name, such as connect_four.")],
    refs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[REF]…", help="Who plays, e.g. connect_four@3. Default: all versions."),
    ] = None,
    schedule: Annotated[
        Schedule,
        typer.Option(
            help="round_robin: everybody meets everybody. gauntlet: each REF meets those of --against. adaptive: those "
            "meet whose order is least plain, in a quarter of the games. cross_play: REFs play together in one team."
        ),
    ] = Schedule.round_robin,
    against: Annotated[
        list[str] | None,
        typer.Option(
            metavar="REF", help="Whom each REF meets in a gauntlet; repeat it. Default: the champion and the scripts."
        ),
    ] = None,
    blocks: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Matches of each pair; a match is two games from one seed, places changed. Adaptive: a quarter of "
            "that on average. Default: 32, or as many as --games, --minutes and --precision allow.",
        ),
    ] = None,
    games: Annotated[int | None, typer.Option(min=2, help="End after this many games.")] = None,
    minutes: Annotated[float | None, typer.Option(help="End after this long.")] = None,
    precision: Annotated[
        float | None, typer.Option(metavar="ELO", help="End when each rating's 95 % interval is within ± this many.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Another one plays fresh games.")] = 0,
    workers: Workers = CORES,
    as_json: AsJson = False,
) -> None:
    """Play a tournament and show who stands where. The scripts `random` and `one_ply` take part where they can.

    Nothing is promoted: that is what `league nightly` and `league promote` do. All matches count for the ratings, but
    for those of cross-play. Started again, it goes on where it was.
    """
    from evaluation.budget import Budget
    from evaluation.tournament import evaluate as run

    Storage.from_environment().export()
    with _shown(quiet=as_json) as listener:
        report = run(
            check_slug("league", league),
            refs or (),
            registry=Registry.open(),
            schedule=schedule.value,
            against=against or (),
            blocks=blocks,
            budget=Budget(games, minutes, precision),
            workers=workers,
            seed=seed,
            listener=listener,
        )
    if as_json:
        emit(report.to_json())
        return
    say(f"{league}: {report.games} games, {report.distinct_games} of them different{_ENDS[report.stopped_by]}\n")
    if report.cross_play is not None:
        _show_cross_play(report.cross_play)
        return
    _show_standings(report.standings)
    for side, standings in report.by_side.items():
        say(f"\nAs {side}:")
        _show_standings(standings)
    _show_payoff(report)
    if report.population is not None:
        _show_population(report.payoff.contestants, report.population)


_ENDS = {
    "schedule": "",
    "games": "; the games are used up",
    "minutes": "; cut short, as the time was up",
    "precision": "; the ratings are precise enough",
}


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


def _show_population(contestants: Sequence[str], shares: Population) -> None:
    say("\nShares of a population of imitators (α-Rank), and of the equilibrium of picking whom to play (Nash) [95 %]:")
    rows = zip(contestants, map(_share, shares.alpha_rank), map(_share, shares.nash), strict=True)
    table(("contestant", "α-Rank", "Nash"), rows)


def _share(estimate: Estimate) -> str:
    """`0.250 [0.100, 0.400]`"""
    bounds = "" if estimate.low is None or estimate.high is None else f" [{estimate.low:.3f}, {estimate.high:.3f}]"
    return f"{estimate.value:.3f}{bounds}"


def _show_cross_play(cross: CrossPlay) -> None:
    say("Mean return of the team [95 %]: the row plays one agent, which goes round, and the column all others:")
    names = [_short(ref) for ref in cross.contestants]
    cells = [[_span(cell) for cell in row] for row in cross.returns]
    table(("", *names), [(name, *row) for name, row in zip(names, cells, strict=True)])
    say(f"\nWith itself {_span(cross.own) or '–'}, with others {_span(cross.mixed) or '–'}.")


def _span(estimate: Estimate | None) -> str | None:
    """`-21.5 [-22.1, -20.9]`"""
    if estimate is None:
        return None
    bounds = "" if estimate.low is None or estimate.high is None else f" [{estimate.low:.4g}, {estimate.high:.4g}]"
    return f"{estimate.value:.4g}{bounds}"


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
