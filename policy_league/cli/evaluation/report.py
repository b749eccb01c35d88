"""`league report`: a league as an HTML page or a JSON document."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.errors import ConfigError
from league.files import disk_errors, replacing
from league.refs import check_slug
from policy_league.cli.options import LeagueName, open_registry
from policy_league.cli.output import console, counted, emit, say, warn_of_changed_game

if TYPE_CHECKING:
    from league.registry.registry import Registry


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
    """Write the results of a league as one HTML file.

    The file contains the web pages with the leaderboard, the payoff matrix, versions, verdicts with their evidence,
    promotions, and replays of the most unexpected results. It needs no network and no server.
    """
    from policy_league.cli.evaluation.report_contents import league_report, plain_document

    if as_json and out is not None:
        raise ConfigError(f"--json prints to stdout and cannot be combined with --out {out}")
    registry = open_registry()
    check_slug("league", league)
    if as_json:
        emit(plain_document(league_report(registry, league)))
        return
    out = out or Path(f"{league}-report.html")
    with console.status(f"reading {league}"):
        contents = plain_document(write_report(registry, league, out))
    counts = (contents["games"], "game"), (len(contents["verdicts"]), "verdict"), (len(contents["upsets"]), "upset")
    say(f"{out}: {', '.join(counted(number, noun) for number, noun in counts)}.")
    if contents["games"]:
        warn_of_changed_game(registry, league)
    for sentence in contents["left_out"]:
        say(sentence)


def write_report(registry: "Registry", league: str, out: Path) -> dict[str, Any]:
    """Write the report of a league to `out` atomically, and return its contents.

    Raises UnknownLeague or StorageError.
    """
    from policy_league.cli.evaluation.report_contents import league_report, report_file

    contents = league_report(registry, league)
    with disk_errors(out, action="written"), replacing(out) as part:
        part.write_bytes(report_file(contents))
    return contents
