"""`league retire`: removes the files of old versions, and old access logs."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.refs import check_slug
from policy_league.cli.options import AsJson, open_registry
from policy_league.cli.output import MEGABYTE, confirm, emit, say, table

if TYPE_CHECKING:
    from league.registry.deletion.retention import Removal


def retire(
    leagues: Annotated[
        list[str] | None, typer.Argument(metavar="[LEAGUE]...", help="Leagues. Default: all registered leagues.")
    ] = None,
    keep: Annotated[int, typer.Option(min=1, help="Number of newest versions per league that stay unchanged.")] = 10,
    days: Annotated[int, typer.Option(min=0, help="Versions and logs of the last DAYS days stay unchanged.")] = 30,
    logs: Annotated[
        Path, typer.Option(metavar="DIR", help="Directory of access logs, inside LEAGUE_HOME unless absolute.")
    ] = Path("logs"),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would be removed, and remove nothing.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Remove files of old versions, and old access logs.

    The training state of a version, its largest part, is removed unless an alias points to the version. All its files
    are removed if also no alias ever pointed to it, and no canary, shadow, verdict or recorded game refers to it. The
    version is then listed as retired, and cannot be served, evaluated or promoted. Verdicts can still be verified and
    games replayed.
    """
    registry = open_registry()
    before = datetime.now(UTC) - timedelta(days=days)
    names = [check_slug("league", name) for name in leagues or ()] or list(registry.leagues.names())
    plans = [registry.retention.plan(name, keep=keep, before=before) for name in names]
    replicas = {registration.replica for registration in registry.replicas.registered()}
    old_logs = former_logs(registry.storage.home / logs, replicas, before)
    is_empty = not old_logs and not any(plan.versions or plan.training for plan in plans)
    if not dry_run and not is_empty:
        size = sum(plan.size for plan in plans) + sum(path.stat().st_size for path in old_logs)
        confirm(f"Remove {size / MEGABYTE:,.0f} MB?", yes=yes)
        plans = [registry.retention.retire(name, keep=keep, before=before) for name in names]
        for path in old_logs:
            path.unlink(missing_ok=True)
    if as_json:
        emit(
            {
                "dry_run": dry_run,
                "leagues": [_document(plan) for plan in plans],
                "logs": [str(path) for path in old_logs],
            }
        )
        return
    if is_empty:
        say("There is nothing to remove.")
        return
    rows = [
        (plan.league, _numbers(plan.versions), _numbers(plan.training), plan.size // MEGABYTE)
        for plan in plans
        if plan.versions or plan.training
    ]
    if rows:
        table(
            ("league", "retired versions", "training state of", "MB"),
            rows,
            prose=("retired versions", "training state of"),
        )
    if old_logs:
        say(f"{'Would remove' if dry_run else 'Removed'} {len(old_logs)} access log files.")


def former_logs(directory: Path, replicas: set[str], before: datetime) -> list[Path]:
    """Return the access logs of replicas that are not registered and that nobody has written to since `before`."""
    log_files = directory.glob("access-*.jsonl*")
    return sorted(
        path
        for path in log_files
        if path.name.removeprefix("access-").partition(".jsonl")[0] not in replicas
        and path.stat().st_mtime < before.timestamp()
    )


def _document(plan: "Removal") -> dict[str, Any]:
    training, versions = (
        {str(number): size for number, size in part.items()} for part in (plan.training, plan.versions)
    )
    return {"league": plan.league, "versions": versions, "training": training}


def _numbers(versions: dict[int, int]) -> str:
    return ", ".join(map(str, versions))
