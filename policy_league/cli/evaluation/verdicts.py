"""`league verify` and `league void`."""

from typing import Annotated

import typer

from policy_league.cli.options import Actor, AsJson, acting, open_registry
from policy_league.cli.output import counted, emit, say

Verdict = Annotated[
    str, typer.Argument(metavar="VERDICT", help="ID of the verdict or its first digits, as shown by `league history`.")
]


def verify(
    verdict: Verdict,
    replays: Annotated[int, typer.Option(min=0, help="Number of games to replay from their seeds.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Recompute a verdict from the ledger and compare the results."""
    from evaluation.gating.verification import verify as run
    from league.registry.verdicts import VOID

    verification = run(verdict, registry=open_registry(), replays=replays)
    if as_json:
        emit(verification.to_json())
        return
    say(
        f"{verification.outcome}: {verification.matches} matches follow the schedule,"
        f" {verification.numbers} recorded numbers reproduced."
    )
    say(verification.reason)
    if verification.remedy:
        say(verification.remedy)
    if verification.replayed:
        say(f"{counted(verification.replayed, 'game')} replayed with identical results.")
    if not verification.is_current:
        games = "Its" if verification.outcome == VOID else "The verdict stands, but its"
        say(f"The league's game or selection of actions has changed since. {games} games count in no current rating.")


def void(
    verdict: Verdict,
    reason: Annotated[str, typer.Option(help="Reason, recorded with time and actor.")],
    purge: Annotated[bool, typer.Option("--purge", help="Also exclude its games from the ratings.")] = False,
    actor: Actor = None,
) -> None:
    """Void a verdict, whether its test is running or complete.

    Its share of alpha remains spent. The next nightly run tests the version again on different games. A promotion that
    resulted from the verdict remains; use `league rollback` to undo it.
    """
    from evaluation.gating.verdicts import void as run
    from league.registry.verdicts import VOID

    registry = open_registry()
    before = registry.verdicts.find(verdict)
    row = run(registry, verdict, actor=acting(actor), reason=reason, purge=purge)
    subject = f"Verdict {row.short_id} on {row.league}@{row.candidate}"
    if before.outcome == VOID:
        say(f"{subject} was already void, {(before.evidence or {}).get('note')}. The first reason is kept.")
    else:
        say(f"{subject} is now void.")
