"""`league keys create`, `list` and `revoke`: who may call a server."""

import re
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from typing import Annotated

import typer

from cli.output import emit, say, table
from league.errors import InvalidInput
from league.refs import check_slug
from league.registry.registry import Registry
from league.registry.rows import KeyRow

app = typer.Typer(
    name="keys",
    no_args_is_help=True,
    help="API keys: who may ask for actions, look at what is served, have games played, and change what is served.\n\n"
    "As soon as there is one, every request needs one: replicas notice within a second.",
)

DURATIONS = {"m": timedelta(minutes=1), "h": timedelta(hours=1), "d": timedelta(days=1), "w": timedelta(weeks=1)}
PERIODS = {"s": 1, "m": 60, "h": 3600}

KeyName = Annotated[str, typer.Argument(metavar="NAME", help="The key's name, which history tells as the actor.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]


@app.command()
def create(
    name: KeyName,
    scopes: Annotated[
        list[str], typer.Option("--scope", help="What for: act, read, evaluate or promote. May be given several times.")
    ],
    leagues: Annotated[
        list[str] | None, typer.Option("--league", help="Only for this league. May be given several times.")
    ] = None,
    expires: Annotated[
        str | None, typer.Option(metavar="DURATION", help="Void after this long: 90m, 12h, 30d, 4w. Default: never.")
    ] = None,
    rate: Annotated[
        str | None, typer.Option(help="At most so many requests, at each replica: 100/s, 600/m. Default: any number.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make an API key and show it, once: only its digest is kept.

    A caller sends it as `Authorization: Bearer plk_…`.
    """
    key, token = Registry.open().create_key(
        name,
        scopes,
        only_leagues=[check_slug("league", league) for league in leagues or ()],
        expires_at=None if expires is None else datetime.now(UTC) + _duration(expires),
        rate=None if rate is None else _rate(rate),
    )
    if as_json:
        emit(_document(key) | {"key": token})
        return
    say(token)
    say(f"\nThis is the only time that the key {name} is shown. Send it as `Authorization: Bearer {token[:12]}_…`.")


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all keys that ever were, with what they are for and whether they still open anything."""
    keys = Registry.open().api_keys()
    if as_json:
        emit({"keys": [_document(key) for key in keys]})
        return
    if not keys:
        say("There is no key yet, so a server on the loopback interface asks for none: league keys create NAME")
        return
    table(
        ("name", "id", "scopes", "leagues", "rate", "made", "expires", "state"),
        [
            (
                key.name,
                key.id,
                sorted(key.scopes),
                "all" if key.leagues is None else sorted(key.leagues),
                None if key.rate is None else f"{key.rate:g}/s",
                key.created_at,
                key.expires_at,
                _state(key),
            )
            for key in keys
        ],
    )


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The key's name, or its id.")], as_json: AsJson = False
) -> None:
    """Make a key void. Every replica refuses it within a second, unless it cannot reach the database just then."""
    key = Registry.open().revoke_key(name)
    if as_json:
        emit(_document(key))
    else:
        say(f"The key {key.name} opens nothing any more.")


def _document(key: KeyRow) -> dict[str, object]:
    document = asdict(key) | {"state": _state(key), "scopes": sorted(key.scopes)}
    del document["sha256"]
    return document | {"leagues": None if key.leagues is None else sorted(key.leagues)}


def _state(key: KeyRow) -> str:
    if key.revoked_at is not None:
        return "revoked"
    return "valid" if key.is_valid(datetime.now(UTC)) else "expired"


def _duration(text: str) -> timedelta:
    found = re.fullmatch(r"([1-9][0-9]{0,4})([mhdw])", text)
    if not found:
        raise InvalidInput(f"--expires {text!r}: expected a number of minutes, hours, days or weeks, such as 30d")
    return int(found[1]) * DURATIONS[found[2]]


def _rate(text: str) -> float:
    """Requests per second."""
    found = re.fullmatch(r"([1-9][0-9]{0,8})/([smh])", text)
    if not found:
        raise InvalidInput(f"--rate {text!r}: expected a number per second, minute or hour, such as 100/s")
    return int(found[1]) / PERIODS[found[2]]
