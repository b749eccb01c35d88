"""The `league` command: subcommands that are imported on demand, and the mapping of errors to exit codes."""

import signal
import sys
from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, NamedTuple

import typer
from typer.core import TyperCommand, TyperGroup

from league.errors import OWN_PACKAGES, InvalidInput, LeagueError, NotFound, one_line, raised_by
from league.interruption import exit_code, on_ending_signals
from policy_league.cli import surroundings

USAGE_ERROR = 2
FAILURE = 1
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
"""Exit codes of commands that a signal ended. Typer's code for any KeyboardInterrupt is the first one."""
ENDING = {"click", "rich", "typer", *OWN_PACKAGES}
"""Packages that end a command."""


class Subcommand(NamedTuple):
    """Where a subcommand is defined, and the first paragraph of its help, which `league --help` shows."""

    target: str
    """`module:attribute` in this package: a function, or a Typer application with subcommands of its own."""
    help: str


PANELS = {
    "Get started": {
        "demo": Subcommand("demo:demo", "Train, evaluate and serve Connect Four, then play a game against it."),
        "doctor": Subcommand("doctor:doctor", "Check packages, CPU, GPU, disk, registry, Ray and HAProxy."),
    },
    "Train": {
        "check-env": Subcommand("training.check_env:check_env", "Test a league's environment against the contract."),
        "train": Subcommand("training.train:train", "Train a league's policies and publish versions."),
        "runs": Subcommand("training.runs:runs", "List a league's training runs, newest first."),
        "sweep": Subcommand("training.sweep:sweep", "Train with each combination of settings and report the best."),
    },
    "Leagues": {
        "init": Subcommand("leagues.init:init", "Write a commented configuration that fits an environment."),
        "list": Subcommand(
            "leagues.listing:list_", "List all leagues with versions, champion, last verdict and night."
        ),
        "archive": Subcommand("leagues.listing:archive", "Archive a league, or make it active again."),
        "compare": Subcommand(
            "leagues.comparison:compare", "Compare two training runs: settings, speed, curves and versions."
        ),
        "recount": Subcommand("leagues.recount:recount", "Compute the sums behind ratings from the ledger again."),
        "remove": Subcommand("leagues.removal:remove", "Remove a league, or one of its versions, with all files."),
    },
    "Evaluate": {
        "evaluate": Subcommand(
            "evaluation.evaluate:evaluate", "Play a tournament; print leaderboard and payoff matrix."
        ),
        "exploitability": Subcommand(
            "evaluation.exploitability:exploitability", "Play a version against its exploiters; print their scores."
        ),
        "nightly": Subcommand(
            "evaluation.nightly:nightly", "Test new versions, promote those that pass, and update the ratings."
        ),
        "report": Subcommand("evaluation.report:report", "Write the results of a league as one HTML file."),
        "replay": Subcommand("evaluation.replay:replay", "Record a game as an animated image, or show it in a window."),
        "verify": Subcommand(
            "evaluation.verdicts:verify", "Recompute a verdict from the ledger and compare the results."
        ),
        "void": Subcommand("evaluation.verdicts:void", "Void a verdict, whether its test is running or complete."),
    },
    "Versions": {
        "versions": Subcommand(
            "versions.listing:versions", "List a league's versions with their aliases and ratings, newest first."
        ),
        "history": Subcommand("versions.aliases:history", "Show when and why an alias moved, and who moved it."),
        "note": Subcommand("versions.listing:note", "Set or clear the note of a version."),
        "import": Subcommand(
            "versions.importing:import_model", "Publish a model that was trained elsewhere as a version."
        ),
        "export": Subcommand("versions.exporting:export", "Write the ONNX files and the manifest of a version."),
        "export-games": Subcommand(
            "versions.exporting:export_games", "Write the recorded games of a league as Parquet, to learn from."
        ),
        "promote": Subcommand(
            "versions.aliases:promote", "Make a version or a mixture the champion, or move another alias to it."
        ),
        "search": Subcommand("versions.searching:search", "Publish a version that plays another one with a search."),
        "retire": Subcommand("versions.retire:retire", "Remove files of old versions, and old access logs."),
        "mixture": Subcommand("versions.aliases:mixture", "Point an alias to the equilibrium of a league, or show it."),
        "rollback": Subcommand("versions.aliases:rollback", "Restore the previous champion."),
    },
    "Serve": {
        "serve": Subcommand("serving.serve:serve", "Serve all leagues over HTTP and gRPC until Ctrl-C."),
        "act": Subcommand("serving.act:act", "Request one action from a policy server, or compute it locally."),
        "traffic": Subcommand("serving.traffic:traffic", "Show or set the canary and the shadow of a league."),
        "replicas": Subcommand("serving.replicas:replicas", "List the serving replicas, or remove one that has ended."),
        "keys": Subcommand("serving.keys:app", "Create, list and revoke API keys."),
    },
}
SUBCOMMANDS = {name: subcommand for panel in PANELS.values() for name, subcommand in panel.items()}


class _ImportedOnDemand(Mapping[str, TyperCommand | TyperGroup]):
    """The commands of `PANELS`. Access to one imports its module."""

    def __getitem__(self, name: str) -> TyperCommand | TyperGroup:
        module, _, attribute = SUBCOMMANDS[name].target.partition(":")
        target = getattr(import_module(f"{__package__}.{module}"), attribute)
        if isinstance(target, typer.Typer):
            command = typer.main.get_command(target)
        else:
            wrapper = typer.Typer(**_SETTINGS)
            wrapper.command(name)(target)
            command = typer.main.get_command(wrapper)
        assert isinstance(command, TyperCommand | TyperGroup)
        return command

    def __iter__(self) -> Iterator[str]:
        return iter(SUBCOMMANDS)

    def __len__(self) -> int:
        return len(SUBCOMMANDS)


class LazyGroup(TyperGroup):
    """A group whose subcommands are imported when they are invoked. Its own help imports none of them."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = _ImportedOnDemand()  # type: ignore[assignment]

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help of the group from the texts of `PANELS`."""
        texts = {
            name: TyperCommand(name, help=subcommand.help, rich_help_panel=panel)
            for panel, subcommands in PANELS.items()
            for name, subcommand in subcommands.items()
        }
        listing = TyperGroup(
            name=self.name,
            commands=texts,  # type: ignore[arg-type]
            help=self.help,
            params=self.params,
            rich_markup_mode=self.rich_markup_mode,
        )
        listing.format_help(ctx, formatter)


_SETTINGS: dict[str, Any] = {"add_completion": False, "rich_markup_mode": "markdown", "pretty_exceptions_enable": False}

app = typer.Typer(
    **_SETTINGS,
    name="league",
    cls=LazyGroup,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def _league() -> None:
    """Train multi-agent policies, decide by statistical tests which version is better, and serve the champion.

    Start with `league demo`. The usual sequence is `train`, `nightly`, `serve`, `act`. Data is stored in LEAGUE_HOME
    (default: ./league-home); LEAGUE_DATABASE_URL and LEAGUE_ARTIFACTS select another database and artefact store.
    """


def run() -> None:
    """Run the command. A LeagueError becomes one line on stderr and exit code 2 (invalid input) or 1."""
    try:
        surroundings.complete()
        try:
            with on_ending_signals():
                if "--json" in sys.argv:
                    from policy_league.cli.output import only_json_on_stdout

                    with only_json_on_stdout():
                        app()
                else:
                    app()
        finally:
            surroundings.flush()
    except LeagueError as error:
        from policy_league.cli.output import complain

        complain(f"league: {one_line(error)}")
        sys.exit(USAGE_ERROR if isinstance(error, InvalidInput | NotFound) else FAILURE)
    except SystemExit as end:
        if end.code == INTERRUPTED or (not end.code and exit_code() != INTERRUPTED):
            sys.exit(exit_code())  # also of a command that has ended in order, such as a server
        if end.code == signal.SIGTERM:  # Ray's handler exits with the number of the signal.
            sys.exit(TERMINATED)
        package, place = raised_by(end)
        if package not in ENDING:
            from policy_league.cli.output import complain

            complain(f"league: {place} called sys.exit()")
            sys.exit(FAILURE)
        raise
