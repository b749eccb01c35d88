"""`league check-env`"""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from cli.output import emit, say, table
from league.config import LeagueConfig


def check_env(
    config: Annotated[Path, typer.Argument(help="The league's file, such as configs/connect_four.yaml.")],
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to play, each several times.")] = 3,
    steps: Annotated[int, typer.Option(min=1, help="Steps after which an episode is left.")] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Of the first episode.")] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON document.")] = False,
) -> None:
    """Play a league's environment with random legal actions and say what does not keep to the contract.

    Exit 1 if there is a fault; notes are worth knowing, no more. Next: `league train CONFIG`.
    """
    league = LeagueConfig.load(config)
    from league.environments.conformance import examine

    found = examine(league, episodes, steps, seed)
    if json:
        emit(asdict(found) | {"passed": found.passed})
    else:
        if found.lengths:
            state = "no global state" if found.state_size is None else f"a global state of {found.state_size:,} numbers"
            say(
                f"{league.environment.entry_point}: {found.api}, {found.agents} agents, {state}, episodes of"
                f" {min(found.lengths)} to {max(found.lengths)} reports, {found.steps_per_second:,.0f} a second"
            )
        if found.findings:
            table(("severity", "finding"), ((finding.severity, str(finding)) for finding in found.findings))
        if found.passed:
            say("It keeps to the contract." if not found.findings else "Nothing worse than notes.")
    raise typer.Exit(0 if found.passed else 1)
