"""`league remove`."""

from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from league.refs import CheckpointRef, check_slug
from policy_league.cli.options import AsJson, open_registry
from policy_league.cli.output import MEGABYTE, confirm, counted, emit, say

if TYPE_CHECKING:
    from league.registry.deletion.removal import RemovalPlan


def remove(
    target: Annotated[str, typer.Argument(metavar="LEAGUE|REF", help="League, or version such as connect_four@3.")],
    force: Annotated[
        bool, typer.Option("--force", help="Also remove the verdicts, aliases and results that depend on it.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be removed, and remove nothing.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove a league, or one of its versions, with all files.

    Refused if a verdict, an alias, a recorded game, another version or a training run depends on it, unless --force is
    given. An interrupted removal is completed when the command is run again. `league archive` and `league retire` keep
    the results.
    """
    registry = open_registry()
    removal = registry.removal
    ref = CheckpointRef.parse(target) if "@" in target else None
    league = ref.league if ref else check_slug("league", target)
    if not dry_run:
        registry.publisher.sweep(league)  # completes an interrupted removal
    plan = removal.plan_version(ref) if ref else removal.plan_league(league)
    if not as_json:
        for sentence in _sentences(plan):
            say(sentence)
    if not dry_run:
        if force or not plan.reasons:
            confirm(f"Remove {plan.target}? This cannot be undone.", yes=yes)
        with registry.exclusive_lock(f"nightly-{league}"):
            if ref is not None:
                plan = removal.remove_version(CheckpointRef.parse(plan.target), force=force)
            else:
                plan = removal.remove_league(league, force=force)
    if as_json:
        sizes = {str(number): size for number, size in plan.versions.items()}
        emit({"dry_run": dry_run} | asdict(plan) | {"versions": sizes})
    elif not dry_run:
        say(f"Removed {plan.target}.")


def _sentences(plan: "RemovalPlan") -> Iterator[str]:
    versions = "" if "@" in plan.target else f"{counted(len(plan.versions), 'version')}, "
    yield f"{plan.target}: {versions}{sum(plan.versions.values()) / MEGABYTE:,.1f} MB of files"
    if plan.aliases:
        yield f"  aliases: {', '.join(plan.aliases)}"
    for count, what in ((len(plan.verdicts), "verdicts"), (plan.matches, "recorded matches"), (len(plan.runs), "runs")):
        if count:
            yield f"  {what}: {count:,}"
    if plan.reasons:
        yield f"In use: {'; '.join(plan.reasons)}."
