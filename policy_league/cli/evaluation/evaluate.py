"""`league evaluate`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

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


def evaluate(
    league: Annotated[
        str, typer.Argument(metavar="LEAGUE|CONFIG", help="Name of the league, or YAML file, which is registered.")
    ],
    refs: Annotated[
        list[str] | None,
        typer.Argument(metavar="[REF]…", help="Contestants, such as connect_four@3. Default: all versions."),
    ] = None,
    schedule: Annotated[
        Literal["round_robin", "gauntlet", "adaptive", "cross_play"],
        typer.Option(
            help="round_robin: all pairs of contestants. gauntlet: each REF against the contestants of --against. "
            "adaptive: the matches that reduce rating uncertainty most, a quarter of the games of a round robin. "
            "cross_play: REFs mixed within one team."
        ),
    ] = "round_robin",
    against: Annotated[
        list[str] | None,
        typer.Option(metavar="REF", help="Opponent in a gauntlet; can be repeated. Default: champion and scripts."),
    ] = None,
    blocks: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Matches per pair. A match is two games with the same seed and swapped sides. Adaptive: a quarter of "
            "this number on average. Default: 32, or unlimited with --games, --minutes or --precision.",
        ),
    ] = None,
    games: Annotated[int | None, typer.Option(min=2, help="Stop after this number of games.")] = None,
    minutes: Annotated[float | None, typer.Option(help="Stop after this time.")] = None,
    precision: Annotated[
        float | None, typer.Option(metavar="ELO", help="Stop when the 95 % interval of each rating is within ± ELO.")
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=MAX_SEED, help="Random seed. Another seed plays different games.")
    ] = 0,
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
            schedule=schedule,
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
        population = zip(payoff.contestants, report.population.alpha_rank, report.population.nash, strict=True)
        table(
            ("contestant", "α-Rank", "Nash"),
            [(ref, _span(rank, ".3f"), _span(share, ".3f")) for ref, rank, share in population],
        )


def _show_matrix(contestants: Sequence[str], cells: Sequence[Sequence[Any]]) -> None:
    names = [ref.rpartition("@")[2] if "@" in ref else ref for ref in contestants]
    table(("", *names), [(name, *row) for name, row in zip(names, cells, strict=True)])


def _span(estimate: "Estimate | None", form: str = ".4g") -> str | None:
    """`-21.5 [-22.1, -20.9]`"""
    if estimate is None:
        return None
    low, high = estimate.low, estimate.high
    bounds = "" if low is None or high is None else f" [{low:{form}}, {high:{form}}]"
    return f"{estimate.value:{form}}{bounds}"
