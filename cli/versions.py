"""`league versions`, `note`, `promote`, `rollback` and `history`."""

import getpass
from dataclasses import asdict
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cli.options import Actor, AsJson, LeagueName, Reason, Timeout, open_registry
from cli.output import elo, emit, say, table
from league.errors import ConfigError, InvalidReference
from league.refs import CHAMPION, CheckpointRef, check_alias, check_slug

if TYPE_CHECKING:
    from evaluation.results import Standing
    from league.registry.registry import Registry
    from league.registry.storage.rows import AliasEvent, VersionRow

Ref = Annotated[str, typer.Argument(metavar="REF", help="Version, such as connect_four@3.")]
Wait = Annotated[bool, typer.Option("--wait", help="Wait until every registered replica serves it; exit 1 on timeout.")]


def versions(league: LeagueName, as_json: AsJson = False) -> None:
    """List a league's versions with their aliases and ratings.

    Ratings are Elo relative to `script:random` with 95 % intervals, from all recorded matches; – means not rated yet.
    """
    registry = open_registry()
    rows = registry.versions.all(check_slug("league", league))
    rated = _ratings(registry, league)
    documents = [_document(row, rated.get(row.ref)) for row in rows]
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
                row.role if row.exploits is None else f"{row.role} of @{CheckpointRef.parse(row.exploits).version}",
                elo(document["rating"], document["interval"]),
                document["games"],
                row.steps,
                row.parent,
                row.created_at,
                row.note and row.note.text,
            )
            for row, document in zip(rows, documents, strict=True)
        ],
    )


def _ratings(registry: "Registry", league: str) -> "dict[str, Standing]":
    """Return the leaderboard by reference. Without games, SciPy is not imported."""
    from league.results.ledger import Ledger

    if not Ledger(registry).counts(league):
        return {}
    from evaluation.matches.leaderboard import compute_leaderboard

    return {standing.ref: standing for standing in compute_leaderboard(registry, league)}


def _document(row: "VersionRow", standing: Any) -> dict[str, Any]:
    return {
        "version": row.number,
        "aliases": list(row.aliases),
        "rating": standing and standing.rating,
        "interval": standing and standing.interval,
        "games": standing.games if standing else 0,
        "steps": row.steps,
        "parent": row.parent,
        "role": row.role,
        "exploits": row.exploits,
        "sha256": row.sha256,
        "created_at": row.created_at,
        "retired_at": row.retired_at,
        "note": row.note and asdict(row.note),
    }


def note(
    ref: Ref,
    text: Annotated[str, typer.Argument(metavar="TEXT", help="New text; an empty string clears the note.")],
    actor: Actor = None,
) -> None:
    """Set or clear the note of a version.

    Notes are shown by `league versions` and on the web pages. The new text replaces the previous one.
    """
    row = open_registry().versions.set_note(CheckpointRef.parse(ref), text, actor=actor or getpass.getuser())
    say(f"{row.ref}: {row.note.text if row.note else 'note cleared'}")


def promote(
    ref: Ref,
    alias: Annotated[str, typer.Option(help="The alias to move.")] = CHAMPION,
    expected: Annotated[
        str | None,
        typer.Option(
            metavar="VERSION", help="Fail unless the alias currently points to this version (`none`: to no version)."
        ),
    ] = None,
    reason: Reason = "promoted by hand",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Make a version the champion, or move another alias to it.

    Replicas serve the new version within a second; --wait waits for their confirmation. Without --expected, the current
    version of the alias is expected, so only one of two concurrent promotions succeeds.
    """
    registry = open_registry()
    version = registry.versions.resolve(CheckpointRef.parse(ref))
    current = registry.aliases.current(version.league).get(check_alias(alias))
    event = registry.aliases.set(
        version.league,
        alias,
        version.number,
        expected=current if expected is None else _expected(expected),
        actor=actor or getpass.getuser(),
        reason=reason,
    )
    _moved(event, as_json, _followers(registry, event, timeout) if wait else None)


def _expected(text: str) -> int | None:
    if text == "none":
        return None
    if not text.isdigit():
        raise InvalidReference(f"--expected {text!r}: expected a version number or `none`")
    return int(text)


def rollback(
    league: LeagueName,
    expected: Annotated[
        int | None, typer.Option(metavar="VERSION", min=1, help="Fail unless this version is the champion.")
    ] = None,
    reason: Reason = "rolled back by hand",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Restore the previous champion.

    Moves the alias `champion` to the version that it pointed to before, and records the move in the history. With
    --expected, only one of several rollbacks of the same version succeeds.
    """
    from league.registry.aliases import ANY

    registry = open_registry()
    event = registry.aliases.rollback(
        check_slug("league", league),
        expected=ANY if expected is None else expected,
        actor=actor or getpass.getuser(),
        reason=reason,
    )
    _moved(event, as_json, _followers(registry, event, timeout) if wait else None)


def _followers(registry: "Registry", event: "AliasEvent", timeout: float) -> list[str]:
    return registry.changes.wait_for_alias(event, timeout)


def _moved(event: "AliasEvent", as_json: bool, replicas: list[str] | None) -> None:
    """Print the move of an alias, and the replicas that have confirmed it."""
    if as_json:
        emit(asdict(event) | ({} if replicas is None else {"replicas": replicas}))
        return
    if event.previous == event.version:
        say(f"{event.league}@{event.alias} already points to version {event.version}.")
    else:
        before = "nothing" if event.previous is None else f"version {event.previous}"
        say(f"{event.league}@{event.alias} now points to version {event.version} (before: {before}).")
    if replicas is not None:
        say(f"All {len(replicas)} replicas serve it.")


def history(
    league: LeagueName,
    alias: Annotated[str, typer.Option(help="Name of the alias.")] = CHAMPION,
    at: Annotated[
        str | None, typer.Option(help="Show only the entry in effect at this time, such as '2026-03-03 14:00'.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show when and why an alias moved, and who moved it."""
    when = None if at is None else _moment(at)
    events = open_registry().aliases.history(check_slug("league", league), check_alias(alias), when)
    if as_json:
        emit({"league": league, "alias": alias, "events": [asdict(event) for event in events]})
        return
    if not events:
        say(f"{league}@{alias} has no history{'' if at is None else ' at that time'}.")
        return
    table(
        ("time", "version", "before", "actor", "reason", "verdict"),
        [(event.at, event.version, event.previous, event.actor, event.reason, event.verdict) for event in events],
    )


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"--at {text!r}: expected a time such as '2026-03-03 14:00'") from error
    return (moment if moment.tzinfo else moment.astimezone()).astimezone(UTC)
