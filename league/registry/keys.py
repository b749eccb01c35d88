"""API keys: scopes, leagues, expiry and rate limit of each client.

    plk_1f3a9c2e_5d0c…    plk_, the key's id, and 256 random bits in hexadecimal

Only the SHA-256 of a key is stored, so that reading the database reveals no key. A slow, salted hash is for passwords,
which can be guessed; 256 random bits cannot, so a fast hash is as safe and lets each request be checked. Rows of keys
are never deleted and names are never reused, because audit records name keys as actors.
"""

import hashlib
import secrets
from collections.abc import Collection
from datetime import UTC, datetime

from sqlalchemy import select
from sqlalchemy.orm import Session

from league.errors import InvalidInput, NameTaken, UnknownKey
from league.refs import check_slug
from league.registry import leagues
from league.registry.storage import change_counter
from league.registry.storage.database import Repository, insert, reading, writing
from league.registry.storage.rows import KeyRow

PREFIX = "plk"
SCOPES = ("act", "read", "evaluate", "promote", "simulate")
"""What a key permits: inference, reading, starting evaluations and games, changing what is served, playing episodes."""
TOKEN_LENGTH = len(PREFIX) + 1 + 8 + 1 + 64


class KeyRepository(Repository):
    """Creates, lists and revokes API keys."""

    @writing
    def create(
        self,
        session: Session,
        name: str,
        scopes: Collection[str],
        *,
        only_leagues: Collection[str] = (),
        expires_at: datetime | None = None,
        rate: float | None = None,
    ) -> tuple[KeyRow, str]:
        """Create an API key; returns it with its text, which is not stored.

        scopes: a subset of `SCOPES`. only_leagues: leagues that the key is valid for, all if empty. rate: requests per
        second, unlimited if None. Raises InvalidReference, InvalidInput, UnknownLeague or NameTaken.
        """
        check_slug("key", name)
        _check(scopes, rate)
        id_ = secrets.token_hex(4)
        token = f"{PREFIX}_{id_}_{secrets.token_hex(32)}"
        values = {
            "id": id_,
            "name": name,
            "sha256": digest(token.encode()),
            "scopes": scopes,
            "leagues": only_leagues or None,
            "rate": rate,
            "created_at": datetime.now(UTC),
            "expires_at": expires_at,
            "revoked_at": None,
        }
        for league in only_leagues:
            leagues.lock(session, league)  # until the key is stored, so that a new league of this name sees it
        change_counter.count(session, "keys")
        if not insert(session, KeyRow, [values]):
            raise NameTaken(f"a key {name!r} exists or existed: names of keys are not reused")
        return session.get_one(KeyRow, id_), token

    @reading
    def all(self, session: Session) -> list[KeyRow]:
        """Return all API keys, revoked ones included, oldest first."""
        query = select(KeyRow).order_by(KeyRow.created_at, KeyRow.id)
        return list(session.scalars(query))

    @writing
    def revoke(self, session: Session, name: str) -> KeyRow:
        """Revoke an API key by its name or id. Idempotent. Raises UnknownKey, which lists the names."""
        query = select(KeyRow).where((KeyRow.name == name) | (KeyRow.id == name)).with_for_update()
        # A name takes precedence over an equal id of another key.
        keys = sorted(session.scalars(query), key=lambda key: key.name != name)
        if not keys:
            names = ", ".join(session.scalars(select(KeyRow.name).order_by(KeyRow.name))) or "none yet"
            raise UnknownKey(f"there is no key {name!r}; known: {names}")
        key = keys[0]
        if key.revoked_at is None:
            change_counter.count(session, "keys")
            key.revoked_at = datetime.now(UTC)
        return key


def digest(token: bytes) -> str:
    """Return the digest of a key's text, as it is stored."""
    return hashlib.sha256(token).hexdigest()


def _check(scopes: Collection[str], rate: float | None) -> None:
    unknown = sorted(set(scopes) - set(SCOPES))
    if unknown or not scopes:
        problem = f"scope {unknown[0]!r} is unknown" if unknown else "a key needs a scope"
        raise InvalidInput(f"{problem}: expected some of {', '.join(SCOPES)}")
    if rate is not None and not 0 < rate < float("inf"):
        raise InvalidInput(f"rate {rate} must be a positive number of requests per second")
