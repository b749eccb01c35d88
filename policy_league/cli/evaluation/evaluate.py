"""`league evaluate`."""

from collections.abc import Sequence
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.refs import check_slug
from league.settings import Storage
from policy_league.cli.options import (
    MAX_SEED,
    AsJson,
    ClusterWorkers,
    EvaluationCluster,
    open_registry,
    workers_for,
)
from policy_league.cli.output import GameProgress, complain, emit, say, show_leaderboard, table
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from evaluation.documents import Estimate, EvaluationReport
    from league.registry.registry import Registry


class ScheduleName(Enum):
    """Schedules of `league evaluate`."""

    round_robin = "round_robin"
    gauntlet = "gauntlet"
    adaptive = "adaptive"
    cross_play = "cross_play"


Refs = Annotated[
    list[str] | None,
    typer.Argument(metavar="[REF]…", help="Contestants, such as connect_four@3. Default: all versions."),
]
Schedule = Annotated[
    ScheduleName,
    typer.Option(
        help="round_robin: all pairs of contestants. gauntlet: each REF against the contestants of --against. "
        "adaptive: the matches that reduce rating uncertainty most, a quarter of the games of a round robin. "
        "cross_play: REFs mixed within one team."
    ),
]
Against = Annotated[
    list[str] | None,
    typer.Option(metavar="REF", help="Opponent in a gauntlet; can be repeated. Default: champion and scripts."),
]
Blocks = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Matches per pair. A match is two games with the same seed and swapped sides. Adaptive: a quarter of "
        "this number on average. Default: 32, or unlimited with --games, --minutes or --precision.",
    ),
]
Games = Annotated[int | None, typer.Option(min=2, help="Stop after this number of games.")]
Minutes = Annotated[float | None, typer.Option(help="Stop after this time.")]
Precision = Annotated[
    float | None, typer.Option(metavar="ELO", help="Stop when the 95 % interval of each rating is within ± ELO.")
]
Seed = Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Random seed. Another seed plays different games.")]


def evaluate(
    league: Annotated[
        str, typer.Argument(metavar="LEAGUE|CONFIG", help="Name of the league, or YAML file, which is registered.")
    ],
    refs: Refs = None,
    schedule: Schedule = ScheduleName.round_robin,
    against: Against = None,
    blocks: Blocks = None,
    games: Games = None,
    minutes: Minutes = None,
    precision: Precision = None,
    seed: Seed = 0,
    workers: ClusterWorkers = None,
    address: EvaluationCluster = None,
    as_json: AsJson = False,
) -> None:
    """Play a tournament; print leaderboard and payoff matrix.

    The scripts `random` and `one_ply` take part where they support the environment. Nothing is promoted; use
    `league nightly` or `league promote`. All matches except cross-play count towards the ratings. An interrupted
    tournament continues when the command is run again.
    """
    from evaluation.matches.tournament import evaluate as run
    from evaluation.schedules.tournament_plan import Budget
    from league.config.league import LeagueConfig
    from league.ray_cluster import ray_session

    Storage.from_environment().export()
    registry = open_registry()
    is_file = league.endswith((".yaml", ".yml"))
    with ray_session(address), GameProgress(quiet=as_json) as listener:
        report = run(
            LeagueConfig.load(find(league)) if is_file else check_slug("league", league),
            refs or (),
            registry=registry,
            schedule=schedule.value,
            against=against or (),
            blocks=blocks,
            budget=Budget(games, minutes, precision),
            workers=workers_for(workers, address),
            seed=seed,
            listener=listener,
        )
    if as_json:
        emit(report.to_json())
    else:
        _show(report, registry)


def _show(report: "EvaluationReport", registry: "Registry") -> None:
    from evaluation.reporting.gate_record import why_not_champion

    end = "" if report.stopped_by == "schedule" else f"; stopped by --{report.stopped_by}"
    say(f"{report.league}: {report.games} games, {report.unique_games} unique{end}\n")
    if report.cross_play is not None:
        cross = report.cross_play
        say("Mean return of the team [95 %]: the row plays one agent (each in turn), the column plays all others:")
        _show_matrix(cross.contestants, [[_span(cell) for cell in row] for row in cross.returns])
        say(f"\nSelf-play {_span(cross.own) or '–'}, cross-play {_span(cross.mixed) or '–'}.")
        return
    show_leaderboard(report.leaderboard, why_not_champion(registry, report.league, report.leaderboard))
    for side, leaderboard in report.by_side.items():
        say(f"\nAs {side}:")
        show_leaderboard(leaderboard)
    payoff = report.payoff
    say(f"\nVersions played with {report.actions} actions.")
    compared = "" if report.scoring == "game" else ", compared on the same side and seed"
    say(f"\nPayoff matrix: score of the row against the column{compared} (1: wins every game, 0.5: even):")
    _show_matrix(payoff.contestants, payoff.score)
    if report.scoring == "side":
        say("\nMean return of the row minus mean return of the column in the same blocks [95 %]:")
        gaps = [[None if gap is None else str(gap) for gap in row] for row in payoff.difference]
        _show_matrix(payoff.contestants, gaps)
    for ref, lost in report.forfeits.items():
        complain(f"{ref} forfeited {lost}")
    if report.population is not None:
        say("\nα-Rank and Nash equilibrium shares [95 %]:")
        shares = map(_share, report.population.alpha_rank), map(_share, report.population.nash)
        table(("contestant", "α-Rank", "Nash"), zip(payoff.contestants, *shares, strict=True))


def _show_matrix(contestants: Sequence[str], cells: Sequence[Sequence[Any]]) -> None:
    names = [ref.rpartition("@")[2] if "@" in ref else ref for ref in contestants]
    table(("", *names), [(name, *row) for name, row in zip(names, cells, strict=True)])


def _share(estimate: "Estimate") -> str:
    """`0.250 [0.100, 0.400]`"""
    bounds = "" if estimate.low is None or estimate.high is None else f" [{estimate.low:.3f}, {estimate.high:.3f}]"
    return f"{estimate.value:.3f}{bounds}"


def _span(estimate: "Estimate | None") -> str | None:
    """`-21.5 [-22.1, -20.9]`"""
    if estimate is None:
        return None
    bounds = "" if estimate.low is None or estimate.high is None else f" [{estimate.low:.4g}, {estimate.high:.4g}]"
    return f"{estimate.value:.4g}{bounds}"
