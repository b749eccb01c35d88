"""The composition of the `league` command, and the edge where errors become sentences and exit codes."""

import os
import sys

import typer

from cli.demo import demo
from cli.doctor import doctor
from cli.environments import check_env
from cli.evaluation import evaluate
from cli.keys import app as keys
from cli.nightly import nightly
from cli.output import complain
from cli.replay import replay
from cli.report import report
from cli.serving import act, serve
from cli.traffic import traffic
from cli.training import sweep, train
from cli.verdicts import verify, void
from cli.versions import history, note, promote, rollback, versions
from league.errors import InvalidInput, LeagueError, NotFound

app = typer.Typer(
    name="league",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Train multi-agent policies, let a league decide which version is really better, and serve the champion.\n\n"
    "A first look: `league demo`. The usual way: `train`, `nightly`, `serve`, `act`. What lives where is set by "
    "LEAGUE_HOME (default ./league-home), LEAGUE_DATABASE_URL and LEAGUE_ARTIFACTS.",
)
for command in (
    demo,
    doctor,
    check_env,
    train,
    sweep,
    versions,
    note,
    evaluate,
    nightly,
    verify,
    void,
    promote,
    rollback,
    history,
    traffic,
    replay,
    report,
    serve,
    act,
):
    app.command()(command)
app.add_typer(keys)

CALLERS_MISTAKE = 2
FAULT = 1


def run() -> None:
    """Run the command. A fault is one line on stderr: exit 2 for the caller's mistake, 1 otherwise."""
    _let_modules_here_be_found()
    try:
        app()
    except LeagueError as error:
        complain(f"league: {' '.join(str(error).split())}")
        sys.exit(CALLERS_MISTAKE if isinstance(error, InvalidInput | NotFound) else FAULT)


def _let_modules_here_be_found() -> None:
    """A league's `entry_point` may lie in the directory where the command is run. Ray hands the path on to workers.

    Behind everything else, so that a file there takes no installed package's place.
    """
    sys.path.append(os.getcwd())
