"""`league evaluate`."""

import os
from typing import Annotated

import typer

from cli.output import elo, emit, errors, say, table
from cli.watching import difference, watched
from evaluation.report import EvaluationReport, Standing
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
    with watched(quiet=as_json) as listener:
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
    show_standings(report.standings)
    for side, standings in report.by_side.items():
        say(f"\nAs {side}:")
        show_standings(standings)
    _show_payoff(report)
    for ref, lost in report.forfeits.items():
        errors.print(f"{ref} forfeited {lost} games: it had no legal action to give", markup=False, soft_wrap=True)


def show_standings(standings: tuple[Standing, ...]) -> None:
    """A table of who stands where."""
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
        cells = [[None if gap is None else difference(gap) for gap in row] for row in payoff.difference]
        table(("", *names), [(name, *row) for name, row in zip(names, cells, strict=True)])


def _short(ref: str) -> str:
    return ref.rpartition("@")[2] if "@" in ref else ref
