"""`league evaluate`."""

import os
from collections.abc import Sequence
from enum import Enum
from typing import Annotated

import typer

from cli.output import complain, elo, emit, say, table
from cli.watching import difference, watched
from evaluation.report import CrossPlay, Estimate, EvaluationReport, Population, Standing
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
Address = Annotated[
    str | None,
    typer.Option(metavar="HOST:PORT", help="Play on this Ray cluster; `auto` finds the one of this machine."),
]
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
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Play a tournament and show who stands where. The scripts `random` and `one_ply` take part where they can.

    Nothing is promoted: that is what `league nightly` and `league promote` do. All matches count for the ratings, but
    for those of cross-play. Started again, it goes on where it was.
    """
    from evaluation.budget import Budget
    from evaluation.cluster import cluster
    from evaluation.tournament import evaluate as run

    Storage.from_environment().export()
    with cluster(address), watched(quiet=as_json) as listener:
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
    _show(report)


_ENDS = {
    "schedule": "",
    "games": "; the games are used up",
    "minutes": "; cut short, as the time was up",
    "precision": "; the ratings are precise enough",
}


def _show(report: EvaluationReport) -> None:
    say(f"{report.league}: {report.games} games, {report.distinct_games} of them different{_ENDS[report.stopped_by]}\n")
    if report.cross_play is not None:
        _show_cross_play(report.cross_play)
        return
    show_standings(report.standings)
    for side, standings in report.by_side.items():
        say(f"\nAs {side}:")
        show_standings(standings)
    _show_payoff(report)
    for ref, lost in report.forfeits.items():
        complain(f"{ref} forfeited {lost} games: it had no legal action to give")
    if report.population is not None:
        _show_population(report.payoff.contestants, report.population)


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


def _short(ref: str) -> str:
    return ref.rpartition("@")[2] if "@" in ref else ref
