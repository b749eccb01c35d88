"""`league versions`, `note`, `promote`, `rollback` and `history`."""

import getpass
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Annotated, Any

import typer

from cli.output import elo, emit, say, table
from league.errors import ConfigError, InvalidReference
from league.refs import CHAMPION, CheckpointRef, check_alias, check_slug
from league.registry.following import await_followers
from league.registry.registry import Registry
from league.registry.rows import AliasEvent, VersionRow

LeagueName = Annotated[str, typer.Argument(metavar="LEAGUE", help="The league's name, such as connect_four.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of a table.")]
Ref = Annotated[str, typer.Argument(metavar="REF", help="Which version, such as connect_four@3.")]
Reason = Annotated[str, typer.Option(help="Why; kept in the history.")]
Actor = Annotated[str | None, typer.Option(help="Who; kept in the history. Default: you.")]
Wait = Annotated[bool, typer.Option("--wait", help="Return when every live replica serves it; exit 1 if one does not.")]
Timeout = Annotated[float, typer.Option(min=0, help="Seconds that --wait waits.")]


def versions(league: LeagueName, as_json: AsJson = False) -> None:
    """List a league's versions with their aliases and ratings.

    A rating is Elo above `script:random` from all matches played so far, with its 95 % interval; – means not yet rated.
    """
    from evaluation.standings import standings

    registry = Registry.open()
    rows = registry.versions(check_slug("league", league))
    rated = {standing.ref: standing for standing in standings(registry, league)}
    documents = [_document(row, rated.get(row.ref)) for row in rows]
    if as_json:
        emit({"league": league, "versions": documents})
        return
    if not rows:
        say(f"{league} has no version yet: league train CONFIG")
        return
    table(
        ("version", "aliases", "rating", "games", "steps", "parent", "made", "note"),
        [
            (
                row.number,
                ", ".join(row.aliases),
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


def _document(row: VersionRow, standing: Any) -> dict[str, Any]:
    return {
        "version": row.number,
        "aliases": list(row.aliases),
        "rating": standing and standing.rating,
        "interval": standing and standing.interval,
        "games": standing.games if standing else 0,
        "steps": row.steps,
        "parent": row.parent,
        "sha256": row.sha256,
        "created_at": row.created_at,
        "note": row.note and asdict(row.note),
    }


def note(
    ref: Ref,
    text: Annotated[str, typer.Argument(metavar="TEXT", help="What people shall know of it; '' takes the note away.")],
    actor: Actor = None,
) -> None:
    """Write of a version what was tried in it, or came of it: `league versions` and the pages show that.

    It takes the place of what was written before.
    """
    row = Registry.open().note(CheckpointRef.parse(ref), text, actor=actor or getpass.getuser())
    say(f"{row.ref}: {row.note.text if row.note else 'there is no note any more'}")


def promote(
    ref: Ref,
    alias: Annotated[str, typer.Option(help="The alias to move.")] = CHAMPION,
    expected: Annotated[
        str | None,
        typer.Option(metavar="VERSION", help="Refuse unless the alias points here now (`none`: nowhere)."),
    ] = None,
    reason: Reason = "promoted by hand",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Make a version the champion (or move another alias to it).

    Every serving replica follows within a second; --wait returns when all have said so. Without --expected the move is
    against what the alias is now, so of two promotions at the same moment one wins and the other is told.
    """
    registry = Registry.open()
    version = registry.resolve(CheckpointRef.parse(ref))
    current = registry.aliases(version.league).get(check_alias(alias))
    event = registry.set_alias(
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
        raise InvalidReference(f"--expected {text!r}: a version number, or `none`, was expected")
    return int(text)


def rollback(
    league: LeagueName,
    reason: Reason = "rolled back by hand",
    actor: Actor = None,
    wait: Wait = False,
    timeout: Timeout = 30.0,
    as_json: AsJson = False,
) -> None:
    """Return to the champion before the present one."""
    registry = Registry.open()
    event = registry.rollback(check_slug("league", league), actor=actor or getpass.getuser(), reason=reason)
    _moved(event, as_json, _followers(registry, event, timeout) if wait else None)


def _followers(registry: Registry, event: AliasEvent, timeout: float) -> list[str]:
    return await_followers(registry, event.league, event.alias, event.version, timeout)


def _moved(event: AliasEvent, as_json: bool, replicas: list[str] | None) -> None:
    """Say what has moved, and who follows if that was waited for."""
    if as_json:
        emit(asdict(event) | ({} if replicas is None else {"replicas": replicas}))
        return
    if event.previous == event.version:
        say(f"{event.league}@{event.alias} is version {event.version} already.")
    else:
        before = "nothing" if event.previous is None else f"version {event.previous}"
        say(f"{event.league}@{event.alias} is now version {event.version} (before: {before}).")
    if replicas is not None:
        say(f"All {len(replicas)} replicas serve it.")


def history(
    league: LeagueName,
    alias: Annotated[str, typer.Option(help="Whose history.")] = CHAMPION,
    at: Annotated[
        str | None, typer.Option(help="Only what was in force at this time, e.g. '2026-03-03 14:00'.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show which version was champion when, who moved it, why, and on which verdict."""
    when = None if at is None else _moment(at)
    events = Registry.open().history(check_slug("league", league), check_alias(alias), when)
    if as_json:
        emit({"league": league, "alias": alias, "events": [asdict(event) for event in events]})
        return
    if not events:
        say(f"{league}@{alias} has no history{'' if at is None else ' at that time'}.")
        return
    table(
        ("when", "version", "before", "who", "why", "verdict"),
        [(event.at, event.version, event.previous, event.actor, event.reason, event.verdict) for event in events],
    )


def _moment(text: str) -> datetime:
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(f"--at {text!r}: expected a time such as '2026-03-03 14:00'") from error
    return (moment if moment.tzinfo else moment.astimezone()).astimezone(UTC)
