"""`league report`: a league as an HTML page or a JSON document."""

from pathlib import Path
from typing import Annotated

import typer

from league.errors import ConfigError
from league.refs import check_slug
from policy_league.cli.options import LeagueName, open_registry
from policy_league.cli.output import console, counted, emit, say, warn_of_changed_game


def report(
    league: LeagueName,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="HTML file. Default: LEAGUE-report.html in the working directory."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the report as one JSON document without images; write no file.")
    ] = False,
) -> None:
    """Write a league's leaderboard, verdicts and upsets as one page.

    The page is a single HTML file that needs no network. It contains the leaderboard, the payoff matrix, every verdict
    with its evidence, and replays of the most unexpected results.
    """
    from evaluation.reporting.html_page import write
    from evaluation.reporting.league_report import league_report

    if as_json and out is not None:
        raise ConfigError(f"--json prints to stdout and cannot be combined with --out {out}")
    registry = open_registry()
    check_slug("league", league)
    if as_json:
        emit(league_report(registry, league, pictures=False).to_json())
        return
    out = out or Path(f"{league}-report.html")
    with console.status(f"reading {league}"):
        content = league_report(registry, league)
    write(content, out)
    counts = (content.games, "game"), (len(content.verdicts), "verdict"), (len(content.upsets), "upset")
    say(f"{out}: {', '.join(counted(number, noun) for number, noun in counts)}.")
    if content.games:
        warn_of_changed_game(registry, league)
    for sentence in content.left_out:
        say(sentence)
