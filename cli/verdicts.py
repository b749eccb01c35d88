"""`league verify` and `league void`."""

import getpass
from typing import Annotated

import typer

from cli.evaluation import AsJson
from cli.output import emit, say
from league.registry.registry import Registry

Verdict = Annotated[str, typer.Argument(metavar="VERDICT", help="Its id, which `league history` and --json tell.")]


def verify(
    verdict: Verdict,
    replays: Annotated[int, typer.Option(min=0, help="Games that are played again from their seeds, too.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Compute a verdict again from the games in the ledger, and fail if its record says anything else."""
    from evaluation.verification import verify as run

    found = run(verdict, registry=Registry.open(), replays=replays)
    if as_json:
        emit(found.to_json())
        return
    say(f"{found.outcome}: {found.matches} matches are as scheduled, and {found.numbers} numbers follow from them.")
    if found.replayed:
        say(f"{found.replayed} games were played again and came out the same.")


def void(
    verdict: Verdict,
    reason: Annotated[str, typer.Option(help="Why; recorded with who and when.")],
    purge: Annotated[bool, typer.Option("--purge", help="Its games shall not count for ratings either.")] = False,
    actor: Annotated[str | None, typer.Option(help="Who says so. Default: the user of this machine.")] = None,
) -> None:
    """Stop a verdict that is being tested, or take back one that has fallen. Its share of alpha is spent.

    The next night judges the version again, on other games. A promotion that the verdict led to stays: that is undone
    by `league rollback`.
    """
    from evaluation.verdicts import void as run

    row = run(Registry.open(), verdict, actor=actor or getpass.getuser(), reason=reason, purge=purge)
    say(f"{verdict} on {row.league}@{row.candidate} is void.")
