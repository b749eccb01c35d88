"""API keys: made, shown once, kept as a digest, and void when they are revoked or have expired."""

import re
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import text

from league.errors import InvalidInput, InvalidReference, NameTaken, UnknownKey, UnknownLeague
from league.registry.keys import SCOPES, TOKEN_LENGTH, digest
from league.registry.registry import Registry
from tests.league.registry.examples import LEAGUE


def test_a_key_is_shown_once_and_kept_as_a_digest(registry: Registry) -> None:
    made, token = registry.create_key("bot", ["read", "act"], only_leagues=[LEAGUE], rate=10)
    assert re.fullmatch(rf"plk_{made.id}_[0-9a-f]{{64}}", token)
    assert len(token) == TOKEN_LENGTH
    assert (made.name, made.scopes, made.leagues, made.rate) == ("bot", {"act", "read"}, {LEAGUE}, 10)
    assert made.sha256 == digest(token.encode())
    assert registry.api_keys() == [made]
    with registry.database.engine.connect() as connection:
        assert token[-64:] not in str(connection.execute(text("SELECT * FROM api_keys")).all())


def test_every_key_is_another(registry: Registry) -> None:
    tokens = {registry.create_key(f"bot-{i}", SCOPES)[1] for i in range(20)}
    assert len(tokens) == 20
    assert [key.name for key in registry.api_keys()] == [f"bot-{i}" for i in range(20)]


def test_a_revoked_key_is_void_and_its_name_is_not_used_again(registry: Registry) -> None:
    made, _ = registry.create_key("bot", ["act"])
    assert made.is_valid(datetime.now(UTC))
    revoked = registry.revoke_key("bot")
    assert not revoked.is_valid(datetime.now(UTC))
    assert registry.revoke_key(made.id) == revoked, "twice is once"
    assert registry.api_keys() == [revoked]
    with pytest.raises(NameTaken, match="'bot'"):
        registry.create_key("bot", ["act"])


def test_a_name_that_is_anothers_id_is_still_that_name(registry: Registry) -> None:
    first, _ = registry.create_key("bot", ["act"])
    registry.create_key(first.id, ["act"])
    assert registry.revoke_key(first.id).name == first.id


def test_a_key_expires(registry: Registry) -> None:
    expires = datetime.now(UTC) + timedelta(days=1)
    made, _ = registry.create_key("bot", ["act"], expires_at=expires)
    assert made.is_valid(expires - timedelta(seconds=1))
    assert not made.is_valid(expires)


def test_what_cannot_be_a_key_is_refused(registry: Registry) -> None:
    with pytest.raises(InvalidReference, match="'A B'"):
        registry.create_key("A B", ["act"])
    with pytest.raises(InvalidInput, match="'root' is unknown: expected some of act, read, evaluate, promote"):
        registry.create_key("bot", ["act", "root"])
    with pytest.raises(InvalidInput, match="needs a scope"):
        registry.create_key("bot", [])
    with pytest.raises(UnknownLeague, match="chess"):
        registry.create_key("bot", ["act"], only_leagues=["chess"])
    for rate in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InvalidInput, match="positive"):
            registry.create_key("bot", ["act"], rate=rate)
    assert registry.api_keys() == []
    with pytest.raises(UnknownKey, match="'bot'; known: none yet"):
        registry.revoke_key("bot")
