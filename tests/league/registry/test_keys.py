"""API keys: the token is shown once and stored as a digest; revoked and expired keys are invalid."""

import re
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import text

from league.errors import InvalidInput, InvalidReference, NameTaken, UnknownKey
from league.registry.keys import SCOPES, TOKEN_LENGTH, digest
from league.registry.registry import Registry
from tests.support.leagues.registries import LEAGUE, registered


def test_a_token_is_returned_once_and_stored_as_a_digest(registry: Registry) -> None:
    key, token = registry.keys.create("bot", ["read", "act"], only_leagues=[LEAGUE], rate=10)
    assert re.fullmatch(rf"plk_{key.id}_[0-9a-f]{{64}}", token)
    assert len(token) == TOKEN_LENGTH
    assert (key.name, key.scopes, key.leagues, key.rate) == ("bot", {"act", "read"}, {LEAGUE}, 10)
    assert key.sha256 == digest(token.encode())
    assert registry.keys.all() == [key]
    with registry.database.engine.connect() as connection:
        assert token[-64:] not in str(connection.execute(text("SELECT * FROM api_keys")).all())


def test_a_key_is_not_valid_for_another_league_of_the_same_name(registry: Registry) -> None:
    registered(registry, "kept")
    registry.keys.create("only", ["act"], only_leagues=[LEAGUE])
    registry.keys.create("both", ["act"], only_leagues=["kept", LEAGUE])
    registry.keys.create("all", ["act"])
    registered(registry)  # again, which changes nothing
    before = {key.name: key for key in registry.keys.all()}
    assert before["only"].leagues == {LEAGUE}
    registry.removal.remove_league(LEAGUE, force=True)
    counts = registry.changes.counts()
    registered(registry)
    after = {key.name: key for key in registry.keys.all()}
    assert after["only"].revoked_at is not None
    assert after["both"].leagues == {"kept"}
    assert after["all"] == before["all"]
    assert registry.changes.counts().keys > counts.keys, "replicas read the keys again"


def test_invalid_keys_are_rejected(registry: Registry) -> None:
    with pytest.raises(InvalidReference, match="'A B'"):
        registry.keys.create("A B", ["act"])
    with pytest.raises(InvalidInput, match="'root' is unknown: expected some of act, read, evaluate, promote"):
        registry.keys.create("bot", ["act", "root"])
    with pytest.raises(InvalidInput, match="needs a scope"):
        registry.keys.create("bot", [])
    for rate in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InvalidInput, match="positive"):
            registry.keys.create("bot", ["act"], rate=rate)
    assert registry.keys.all() == []
    with pytest.raises(UnknownKey, match="'bot'; known: none yet"):
        registry.keys.revoke("bot")


def test_a_key_is_valid_until_it_expires_or_is_revoked(registry: Registry) -> None:
    expires = datetime.now(UTC) + timedelta(days=1)
    key, _ = registry.keys.create("bot", ["act"], expires_at=expires)
    assert key.is_valid(expires - timedelta(seconds=1))
    assert not key.is_valid(expires)
    revoked = registry.keys.revoke("bot")
    assert not revoked.is_valid(datetime.now(UTC))
    assert registry.keys.revoke(key.id) == revoked, "revoking twice has no effect"
    assert registry.keys.all() == [revoked]
    with pytest.raises(NameTaken, match="'bot'"):
        registry.keys.create("bot", ["act"])
    registry.keys.create(key.id, ["act"])
    assert registry.keys.revoke(key.id).name == key.id, "a name has precedence over an id"
    tokens = {registry.keys.create(f"bot-{i}", SCOPES)[1] for i in range(20)}
    assert len(tokens) == 20
    assert [row.name for row in registry.keys.all()][2:] == [f"bot-{i}" for i in range(20)]
