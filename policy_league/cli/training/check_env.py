"""`league check-env`."""

from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Annotated

import typer

from policy_league.cli.options import DEFAULT_SECONDS, MAX_SEED, AsJson, Config, Seconds, open_registry
from policy_league.cli.output import counted, emit, progress, say, table
from policy_league.configs.bundled import find

if TYPE_CHECKING:
    from league.config.league import LeagueConfig
    from league.environments.conformance.findings import Examination


def check_env(
    config: Config,
    episodes: Annotated[int, typer.Option(min=1, help="Number of episodes, each played several times.")] = 3,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of steps per episode. Default: play.max_moves.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=MAX_SEED, help="Seed of the first episode.")] = 0,
    seconds: Seconds = DEFAULT_SECONDS,
    as_json: AsJson = False,
) -> None:
    """Test a league's environment against the contract.

    Plays episodes with random legal actions, and checks the scripts, bots and versions that CONFIG names. Exits 1 on a
    violation; notes do not affect the exit code.

    Next step: `league train CONFIG`.
    """
    from league.config.league import LeagueConfig
    from league.environments.conformance.examination import examine
    from league.policies.loading import faults_of_contestants

    league = LeagueConfig.load(find(config))
    with progress(f"checking {league.environment.entry_point}") as show:
        examination = examine(league, episodes, steps, seed, seconds=seconds, progress=show)
    if examination.interface is not None:
        for error in faults_of_contestants(league, examination.interface, open_registry):
            examination.add("fault", str(error))
    if as_json:
        document = asdict(replace(examination, interface=None))
        del document["interface"]
        emit(document | {"passed": examination.passed})
    else:
        _show(league, examination)
    raise typer.Exit(0 if examination.passed else 1)


def _show(league: "LeagueConfig", found: "Examination") -> None:
    if found.lengths:
        state = "no global state" if found.state_size is None else f"a global state of {found.state_size:,} numbers"
        say(
            f"{league.environment.entry_point}: {found.api}, {counted(found.agents, 'agent')}, {state}, episodes of"
            f" {_lengths(found)}, {found.steps_per_second:,.{found.steps_per_second < 10:d}f} steps per second"
        )
        say("\n".join(filter(None, (found.implementation, found.policies, found.actions))))
        if (openings := found.openings) is not None:
            say(str(openings))
            if (plies := league.play.opening_plies) != openings.recommended and 0 < plies <= len(openings.lengths):
                say(f"play.opening_plies is {plies}. {openings.effect(plies)}.")
    elif league.environment.external is not None:
        say("\n".join((found.policies, found.actions, "What simulators report is checked when they play.")))
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


def _lengths(found: "Examination") -> str:
    """`10 steps`, `34 to 59 steps`, or `12 or more steps` if an episode was cut."""
    least, most = min(found.lengths), max(found.lengths)
    if found.actions_per_episode is None:
        return f"{most:,} or more steps"
    return counted(most, "step") if least == most else f"{least:,} to {most:,} steps"
