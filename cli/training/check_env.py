"""`league check-env`."""

from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated

import typer

from cli.options import AsJson, Config, open_registry
from cli.output import emit, say, table
from configs.bundled import find

if TYPE_CHECKING:
    from league.config.league import LeagueConfig
    from league.environments.conformance.findings import Examination


def check_env(
    config: Config,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes, each played several times.")] = 3,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of steps per episode. Default: play.max_moves.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Test a league's environment against the contract.

    Plays episodes with random legal actions, and checks the scripts, bots and versions that CONFIG names. Exits 1 on a
    violation; notes do not affect the exit code.

    Next step: `league train CONFIG`.
    """
    from league.config.league import LeagueConfig
    from league.environments.conformance.examination import examine
    from league.policies.loading import errors_of_contestants

    league = LeagueConfig.load(find(config))
    found = examine(league, episodes, steps, seed)
    if found.interface is not None:
        for error in errors_of_contestants(league, found.interface, open_registry):
            found.add("fault", str(error))
    if as_json:
        document = asdict(replace(found, interface=None))
        del document["interface"]
        emit(document | {"passed": found.passed})
    else:
        _show(league, found)
    raise typer.Exit(0 if found.passed else 1)


def _show(league: "LeagueConfig", found: "Examination") -> None:
    if found.lengths:
        state = "no global state" if found.state_size is None else f"a global state of {found.state_size:,} numbers"
        say(
            f"{league.environment.entry_point}: {found.api}, {found.agents} agents, {state}, episodes of"
            f" {min(found.lengths)} to {max(found.lengths)} steps, {found.steps_per_second:,.0f} steps per second"
        )
        say(found.implementation)
        say(found.policies)
        say(found.actions)
        if (openings := found.openings) is not None:
            say(str(openings))
            if (plies := league.play.opening_plies) != openings.recommended and 0 < plies <= len(openings.lengths):
                say(f"play.opening_plies is {plies}. {openings.effect(plies)}.")
    if (vectorised := found.vectorised) is not None:
        ratio = vectorised.steps_per_second / vectorised.stock_steps_per_second
        say(
            f"The vectorised and the stock environment reported the same in {vectorised.steps:,} steps. Steps per"
            f" second: {vectorised.steps_per_second:,.0f} with {vectorised.copies:,} copies, stock"
            f" {vectorised.stock_steps_per_second:,.0f} ({ratio:.0f}×)."
        )
    if found.findings:
        rows = [(finding.severity, str(finding)) for finding in found.findings]
        table(("severity", "finding"), rows, prose=("finding",))
    if found.passed:
        say("The environment passes all checks." if not found.findings else "The environment passes, with notes.")
