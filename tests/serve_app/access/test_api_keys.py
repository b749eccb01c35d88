"""The key cache of a replica."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from league.registry.keys import digest
from league.registry.storage.rows import KeyRow
from serve_app.access.api_keys import ApiKeyCache

TOKEN = b"plk_00000000_" + b"a" * 64


@pytest.fixture
def row() -> KeyRow:
    return KeyRow(
        id="00000000",
        name="bot",
        sha256=digest(TOKEN),
        scopes=frozenset(["act"]),
        leagues=None,
        rate=1.0,
        created_at=datetime.now(UTC),
        expires_at=None,
        revoked_at=None,
    )


@pytest.fixture
def api_keys(row: KeyRow) -> ApiKeyCache:
    api_keys = ApiKeyCache()
    assert api_keys.is_empty
    api_keys.update([row])
    return api_keys


def test_a_key_is_found_by_its_token_only(api_keys: ApiKeyCache, row: KeyRow) -> None:
    key = api_keys.find(TOKEN)
    assert key is not None
    assert (key.name, key.id, key.scopes, key.leagues) == ("bot", row.id, {"act"}, None)
    for wrong in (b"", TOKEN[:-1], TOKEN + b"a", TOKEN[:-1] + b"b", row.sha256.encode(), b"\xff" * len(TOKEN)):
        assert api_keys.find(wrong) is None


def test_an_expired_key_is_not_found(api_keys: ApiKeyCache, row: KeyRow) -> None:
    api_keys.update([replace(row, expires_at=datetime.now(UTC) - timedelta(seconds=1))])
    assert api_keys.find(TOKEN) is None
    api_keys.update([replace(row, expires_at=datetime.now(UTC) + timedelta(hours=1))])
    assert api_keys.find(TOKEN)


def test_a_revoked_key_is_not_found_but_the_cache_is_not_empty(api_keys: ApiKeyCache, row: KeyRow) -> None:
    api_keys.update([replace(row, revoked_at=datetime.now(UTC))])
    assert api_keys.find(TOKEN) is None
    assert not api_keys.is_empty, "an empty cache would unlock the server"


def test_an_update_does_not_reset_the_rate_limit(api_keys: ApiKeyCache, row: KeyRow) -> None:
    key = api_keys.find(TOKEN)
    assert key is not None
    assert key.bucket is not None
    assert key.bucket.take() == 0
    api_keys.update([row])
    again = api_keys.find(TOKEN)
    assert again is not None
    assert again.bucket is not None
    assert again.bucket.take() > 0
