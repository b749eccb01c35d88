"""API keys: who may call a server, for what, until when and how often.

    plk_1f3a9c2e_5d0c…    plk_, the key's id, and 256 random bits in hexadecimal

Only the SHA-256 of a key is kept, so that whoever reads the database learns no key. A slow, salted hash is for
passwords, which can be guessed; 256 random bits cannot, so a fast hash is as safe and lets each request be checked.
The row of a key is never removed, nor its name used again: history names keys as actors.
"""

import hashlib
import secrets
from collections.abc import Collection
from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.errors import InvalidInput, NameTaken, UnknownKey
from league.refs import check_slug
from league.registry import leagues, rows
from league.registry.database import insert
from league.registry.tables import ApiKey

PREFIX = "plk"
SCOPES = ("act", "read", "evaluate", "promote")
"""What a key may be for: asking for actions, reading what is served, having games played, changing what is served."""
TOKEN_LENGTH = len(PREFIX) + 1 + 8 + 1 + 64


def digest(token: bytes) -> str:
    """What is kept of a key's text."""
    return hashlib.sha256(token).hexdigest()


def create(
    session: Session,
    name: str,
    scopes: Collection[str],
    *,
    only_leagues: Collection[str] = (),
    expires_at: datetime | None = None,
    rate: float | None = None,
) -> tuple[rows.KeyRow, str]:
    """Make a key; returns it with its text, which cannot be had again.

    only_leagues: those that it is for, all if empty. rate: requests per second, unbounded if None.
    Raises InvalidReference, InvalidInput, UnknownLeague or NameTaken.
    """
    check_slug("key", name)
    _check(scopes, rate)
    for league in only_leagues:
        leagues.require(session, league)
    id_ = secrets.token_hex(4)
    token = f"{PREFIX}_{id_}_{secrets.token_hex(32)}"
    values = {
        "id": id_,
        "name": name,
        "sha256": digest(token.encode()),
        "scopes": [scope for scope in SCOPES if scope in scopes],
        "leagues": sorted(set(only_leagues)) or None,
        "rate": rate,
        "created_at": datetime.now(UTC),
        "expires_at": expires_at,
        "revoked_at": None,
    }
    if not insert(session, ApiKey, [values]):
        raise NameTaken(f"there is or was a key {name!r} already: names are not used again, for history tells by them")
    return _row(session.get_one(ApiKey, id_)), token


def every(session: Session) -> list[rows.KeyRow]:
    """All keys that ever were, in the order in which they were made."""
    return [_row(key) for key in session.scalars(select(ApiKey).order_by(ApiKey.created_at, ApiKey.id))]


def revoke(session: Session, name: str) -> rows.KeyRow:
    """Make a key void; twice is once. `name` may be its id. Raises UnknownKey, which lists the names."""
    query = select(ApiKey).where((ApiKey.name == name) | (ApiKey.id == name)).with_for_update()
    # A name that looks like another's id is still that name.
    found = sorted(session.scalars(query), key=lambda key: key.name != name)
    if not found:
        known = ", ".join(session.scalars(select(ApiKey.name).order_by(ApiKey.name))) or "none yet"
        raise UnknownKey(f"there is no key {name!r}; known: {known}")
    key = found[0]
    key.revoked_at = key.revoked_at or datetime.now(UTC)
    return _row(key)


def _check(scopes: Collection[str], rate: float | None) -> None:
    unknown = sorted(set(scopes) - set(SCOPES))
    if unknown or not scopes:
        given = f"scope {unknown[0]!r} is unknown" if unknown else "a key needs a scope"
        raise InvalidInput(f"{given}: expected some of {', '.join(SCOPES)}")
    if rate is not None and not 0 < rate < float("inf"):
        raise InvalidInput(f"rate {rate} must be a positive number of requests per second")


def _row(key: ApiKey) -> rows.KeyRow:
    return rows.KeyRow(
        id=key.id,
        name=key.name,
        sha256=key.sha256,
        scopes=frozenset(key.scopes),
        leagues=None if key.leagues is None else frozenset(key.leagues),
        rate=key.rate,
        created_at=key.created_at,
        expires_at=key.expires_at,
        revoked_at=key.revoked_at,
    )
