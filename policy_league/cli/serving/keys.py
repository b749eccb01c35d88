"""`league keys create`, `list` and `revoke`: management of API keys."""

import re
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Annotated

import typer

from league.errors import InvalidInput
from league.refs import check_slug
from policy_league.cli.options import AsJson, open_registry
from policy_league.cli.output import complain, emit, say, table

if TYPE_CHECKING:
    from league.registry.storage.rows import KeyRow

app = typer.Typer(
    name="keys",
    no_args_is_help=True,
    help="Create, list and revoke API keys.\n\n"
    "A key permits action requests, reading, evaluations, promotions or simulators. As soon as one key exists, every"
    " request needs one. Replicas apply changes within a second.",
)

DURATIONS = {"m": timedelta(minutes=1), "h": timedelta(hours=1), "d": timedelta(days=1), "w": timedelta(weeks=1)}
PERIODS = {"s": 1, "m": 60, "h": 3600}


@app.command()
def create(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the key, recorded in histories as the actor.")],
    scopes: Annotated[
        list[str],
        typer.Option("--scope", help="Permission: act, read, evaluate, promote or simulate. Can be repeated."),
    ],
    leagues: Annotated[
        list[str] | None,
        typer.Option("--league", help="Restrict the key to this league. Can be repeated. Default: all leagues."),
    ] = None,
    expires: Annotated[
        str | None, typer.Option(metavar="DURATION", help="Lifetime: 90m, 12h, 30d, 4w. Default: unlimited.")
    ] = None,
    rate: Annotated[str | None, typer.Option(help="Rate limit per replica: 100/s, 600/m. Default: unlimited.")] = None,
    as_json: AsJson = False,
) -> None:
    """Create an API key and print it. It cannot be shown again, as only its digest is stored.

    Clients send it in the header `Authorization: Bearer plk_…`. Only the key is printed to stdout.
    """
    key, token = open_registry().keys.create(
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
    complain(
        f"\nStore the key {name} now: it is not shown again. Clients send `Authorization: Bearer {token[:12]}_…`.\n"
        "From now on, servers require a key for every request, unless deploy.yaml sets require_keys to never."
    )


@app.command("list")
def list_(as_json: AsJson = False) -> None:
    """List all API keys with their permissions and state, including revoked and expired ones."""
    keys = open_registry().keys.all()
    if as_json:
        emit({"keys": [_document(key) for key in keys]})
        return
    if not keys:
        say("No API keys: a server on the loopback interface accepts all requests. See `league keys create --help`.")
        return
    table(
        ("name", "id", "scopes", "leagues", "rate", "created", "expires", "state"),
        [
            (
                key.name,
                key.id,
                sorted(key.scopes),
                "all" if key.leagues is None else sorted(key.leagues),
                None if key.rate is None else f"{key.rate:g}/s",
                f"{key.created_at.astimezone():%Y-%m-%d}",
                None if key.expires_at is None else f"{key.expires_at.astimezone():%Y-%m-%d %H:%M}",
                _state(key),
            )
            for key in keys
        ],
        prose=("scopes", "leagues"),
        optional=("rate", "expires"),
    )


@app.command()
def revoke(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name or ID of the key.")], as_json: AsJson = False
) -> None:
    """Revoke an API key. Every replica that can reach the database rejects it within a second."""
    keys = open_registry().keys
    key = keys.revoke(name)
    if as_json:
        emit(_document(key))
    else:
        say(f"Revoked the key {key.name}.")
        if not any(_state(stored_key) == "valid" for stored_key in keys.all()):
            say("No valid key is left. Servers continue to require one: league keys create NAME --scope SCOPE")


def _document(key: "KeyRow") -> dict[str, object]:
    document = asdict(key) | {"state": _state(key), "scopes": sorted(key.scopes)}
    del document["sha256"]
    return document | {"leagues": None if key.leagues is None else sorted(key.leagues)}


def _state(key: "KeyRow") -> str:
    if key.revoked_at is not None:
        return "revoked"
    return "valid" if key.is_valid(datetime.now(UTC)) else "expired"


def _duration(text: str) -> timedelta:
    match = re.fullmatch(r"([1-9][0-9]{0,4})([mhdw])", text)
    if not match:
        raise InvalidInput(f"--expires {text!r}: expected a number of minutes, hours, days or weeks, such as 30d")
    return int(match[1]) * DURATIONS[match[2]]


def _rate(text: str) -> float:
    """Requests per second."""
    match = re.fullmatch(r"([1-9][0-9]{0,8})/([smh])", text)
    if not match:
        raise InvalidInput(f"--rate {text!r}: expected a number per second, minute or hour, such as 100/s")
    return int(match[1]) / PERIODS[match[2]]
