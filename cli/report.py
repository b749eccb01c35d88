"""`league report`: a league as one page, or as one JSON document."""

from pathlib import Path
from typing import Annotated

import typer

from cli.output import console, emit, say
from league.errors import ConfigError
from league.refs import check_slug
from league.registry.registry import Registry


def report(
    league: Annotated[str, typer.Argument(metavar="LEAGUE", help="The league's name, such as connect_four.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The HTML file. Default: LEAGUE-report.html in this directory.")
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the same as one JSON document, without pictures, and write no file.")
    ] = False,
) -> None:
    """Show a league on one page: standings, who beats whom, every verdict with its evidence, and surprising games.

    The page is one file that needs no network: open it from the disk, mail it, print it. Nothing is played for it but
    the surprising games once more, from their records.
    """
    from evaluation.pages.league_report import league_report
    from evaluation.pages.page import write

    if as_json and out is not None:
        raise ConfigError(f"--json is printed and writes no file: leave out --out {out}")
    registry = Registry.open()
    check_slug("league", league)
    if as_json:
        emit(league_report(registry, league, pictures=False).to_json())
        return
    out = out or Path(f"{league}-report.html")
    with console.status(f"reading {league}"):
        found = league_report(registry, league)
    write(found, out)
    say(f"{out}: {found.games} games, {len(found.verdicts)} verdicts, {len(found.surprises)} surprising games.")
    for sentence in found.left_out:
        say(sentence)
