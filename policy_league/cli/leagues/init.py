"""`league init`: writes a configuration for an environment."""

import os
import re
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer

from league.errors import ConfigError, InvalidInput
from league.refs import check_slug
from policy_league.cli.options import DEFAULT_SECONDS, Seconds
from policy_league.cli.output import progress, say

ADAPTER = "openspiel"


def init(
    entry_point: Annotated[
        str,
        typer.Argument(
            metavar="ENTRY_POINT",
            help="Function package.module:make_env, PettingZoo module such as pettingzoo.classic.tictactoe_v3, or"
            " openspiel.",
        ),
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="YAML file. Default: NAME.yaml.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the league. Default: the name of the module.")
    ] = None,
    argument: Annotated[
        list[str] | None,
        typer.Option("--arg", metavar="NAME=VALUE", help="Argument of the constructor, such as game=kuhn_poker."),
    ] = None,
    team: Annotated[
        bool | None,
        typer.Option(
            "--team/--no-team",
            help="All agents are one side, or each is a side of its own. Default: a team if their returns agree.",
        ),
    ] = None,
    seconds: Seconds = DEFAULT_SECONDS,
) -> None:
    """Write a commented configuration that fits an environment.

    Builds the environment and plays it as `league check-env` does. Agents with equal spaces share a policy; the network
    and the algorithm fit the spaces; random openings are recommended if seeds alone repeat the same game. An existing
    file is never overwritten.

    Next step: `league train FILE`.
    """
    from league.environments.conformance.proposal import propose
    from league.files import disk_errors, replacing

    kwargs = dict(_pair(text) for text in argument or ())
    league = check_slug("league", name or _name(entry_point, kwargs))
    path = output or Path(f"{league}.yaml")
    folder = path.resolve().parent
    if path.exists():
        raise ConfigError(f"{path} exists and is not overwritten: choose another file with --output")
    if not folder.is_dir():
        raise ConfigError(f"{path}: {folder} is not a directory")
    with progress(f"playing {entry_point}") as show:
        proposal = propose(
            league,
            entry_point,
            kwargs,
            *_search(entry_point, folder),
            is_team=team,
            seconds=seconds,
            progress=show,
        )
    with disk_errors(path, action="written"), replacing(path) as part:
        part.write_text(proposal.text, encoding="utf-8")
    examination = proposal.examination
    say(f"{examination.policies}\n{examination.actions}")
    if proposal.config.play.actions == "greedy" and examination.openings is not None:
        say(str(examination.openings))
    for finding in examination.findings:
        if "play.opening_plies" not in finding.text:  # the file sets it
            say(f"Note: {finding}")
    if team is None and examination.is_team:
        say("The file makes all agents one team. If they are opponents, use --no-team.")
    elif team is None and any("one team" in finding.text for finding in examination.findings):
        say("The file makes each agent a side of its own. If they are one team, use --team.")
    say(f"Wrote {path}. Next: league train {shlex.quote(str(path))}")


def _pair(text: str) -> tuple[str, Any]:
    import yaml

    name, equals, value = text.partition("=")
    if not (name and equals):
        raise InvalidInput(f"--arg {text!r}: expected NAME=VALUE")
    try:
        return name, yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise InvalidInput(f"--arg {text!r}: the value is not valid YAML") from error


def _name(entry_point: str, kwargs: dict[str, Any]) -> str:
    """`my_game` of `my_package.my_game:make_env`, `tictactoe` of `pettingzoo.classic.tictactoe_v3`."""
    if entry_point == ADAPTER:
        stem = str(kwargs.get("game", ADAPTER)).partition("(")[0]
    else:
        stem = re.sub(r"_v\d+$", "", entry_point.partition(":")[0].rpartition(".")[2])
    return re.sub(r"[^a-z0-9_-]|^-", "_", stem.lower())


def _search(entry_point: str, folder: Path) -> tuple[str, str | None]:
    """Where the code is searched, and this folder relative to `folder` if it is another one.

    It is the working directory if only that contains the code.
    """
    from league.environment_code import module_in

    package, working_directory = entry_point.partition(":")[0].partition(".")[0], Path.cwd()
    if package.isidentifier() and not module_in(str(folder), package) and module_in(str(working_directory), package):
        return str(working_directory), os.path.relpath(working_directory, folder)
    return str(folder), None
