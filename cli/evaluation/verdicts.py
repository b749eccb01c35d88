"""`league verify` and `league void`."""

import getpass
from typing import Annotated

import typer

from cli.options import Actor, AsJson, open_registry
from cli.output import counted, emit, say

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

    found = run(verdict, registry=open_registry(), replays=replays)
    if as_json:
        emit(found.to_json())
        return
    say(f"{found.outcome}: {found.matches} matches follow the schedule, {found.numbers} recorded numbers reproduced.")
    if found.replayed:
        say(f"{counted(found.replayed, 'game')} replayed with identical results.")
    if not found.is_current:
        say("The game of the league has changed since. The verdict stands, but its games count in no current rating.")


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

    row = run(open_registry(), verdict, actor=actor or getpass.getuser(), reason=reason, purge=purge)
    say(f"Verdict {row.short_id} on {row.league}@{row.candidate} is now void.")
