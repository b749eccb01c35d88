"""`league versions` and `league note`."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from league.refs import (
    CheckpointRef,
    check_slug,
)
from policy_league.cli.options import Actor, AsJson, LeagueName, acting, open_registry
from policy_league.cli.output import elo, emit, say, table, warn_of_changed_game

if TYPE_CHECKING:
    from league.registry.registry import Registry
    from league.registry.storage.rows import VersionRow

SHOWN = 20
"""Number of versions in a table."""


def versions(
    league: LeagueName,
    limit: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of versions. Default: 20; with --json all, oldest first.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List a league's versions with their aliases and ratings, newest first.

    Ratings are Elo relative to `script:random` with 95 % intervals, from all recorded matches; – means not rated yet.
    """
    registry = open_registry()
    check_slug("league", league)
    if as_json and limit is None:
        rows, older = registry.versions.all(league), []
    else:
        limit = limit or SHOWN
        newest = registry.versions.newest(league, limit=limit + 1)
        rows, older = newest[:limit], newest[limit:]
    rated = _ratings(registry, league)
    documents = [_document(row, rated.get(row.ref, {})) for row in rows]
    if as_json:
        emit({"league": league, "versions": documents})
        return
    if not rows:
        say(f"{league} has no versions yet. Create one: league train CONFIG")
        return
    table(
        ("version", "aliases", "role", "rating", "games", "steps", "parent", "created", "note"),
        [
            (
                row.number,
                ", ".join(row.aliases) if row.retired_at is None else "retired",
                _role(row),
                elo(document["rating"], document["interval"]),
                document["games"],
                row.steps,
                row.parent,
                f"{row.created_at.astimezone():%Y-%m-%d}",
                row.note and row.note.text,
            )
            for row, document in zip(rows, documents, strict=True)
        ],
        prose=("note",),
        optional=("role", "parent", "note"),
    )
    if older:
        say(f"Older versions are not shown: --limit, now {limit}.")
    if rated:
        warn_of_changed_game(registry, league)


def _role(row: "VersionRow") -> str | None:
    if row.mixture is not None:
        return f"{row.role} of {row.mixture}"
    if row.search is not None:
        return f"{row.role} with {row.search}"
    return None if row.exploits is None else f"{row.role} of @{CheckpointRef.parse(row.exploits).version}"


def _ratings(registry: "Registry", league: str) -> dict[str, dict[str, Any]]:
    """Return the leaderboard by reference. Without games, or if a server has computed it, SciPy is not imported."""
    from league.results.ledger import Ledger

    if not Ledger(registry).counts(league):
        return {}
    if snapshot := registry.snapshots.current(league, "leaderboard"):
        return {standing["ref"]: standing for standing in snapshot.document["leaderboard"]}
    from evaluation.matches.leaderboard import compute_leaderboard

    return {standing.ref: standing.to_json() for standing in compute_leaderboard(registry, league)}


def _document(row: "VersionRow", standing: dict[str, Any]) -> dict[str, Any]:
    return {
        "version": row.number,
        "aliases": list(row.aliases),
        "rating": standing.get("rating"),
        "interval": standing.get("interval"),
        "games": standing.get("games", 0),
        "steps": row.steps,
        "parent": row.parent,
        "role": row.role,
        "exploits": row.exploits,
        "members": row.mixture and [member.model_dump() for member in row.mixture.members],
        "search": row.search and row.search.model_dump(),
        "sha256": row.sha256,
        "created_at": row.created_at,
        "retired_at": row.retired_at,
        "note": row.note and asdict(row.note),
    }


def note(
    ref: Annotated[str, typer.Argument(metavar="REF", help="Version, such as connect_four@3.")],
    text: Annotated[str, typer.Argument(metavar="TEXT", help="New text; an empty string clears the note.")],
    actor: Actor = None,
) -> None:
    """Set or clear the note of a version.

    Notes are shown by `league versions` and on the web pages. The new text replaces the previous one.
    """
    row = open_registry().versions.set_note(CheckpointRef.parse(ref), text, actor=acting(actor))
    say(f"{row.ref}: {row.note.text if row.note else 'note cleared'}")
