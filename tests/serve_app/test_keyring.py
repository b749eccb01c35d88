"""The keys in a replica's memory."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from league.registry.keys import digest
from league.registry.rows import KeyRow
from serve_app.keyring import Keyring

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
def keyring(row: KeyRow) -> Keyring:
    keyring = Keyring()
    assert keyring.is_empty
    keyring.follow([row])
    return keyring


def test_a_key_is_found_by_its_text_alone(keyring: Keyring, row: KeyRow) -> None:
    key = keyring.find(TOKEN)
    assert key is not None
    assert (key.name, key.id, key.scopes, key.leagues) == ("bot", row.id, {"act"}, None)
    for wrong in (b"", TOKEN[:-1], TOKEN + b"a", TOKEN[:-1] + b"b", row.sha256.encode(), b"\xff" * len(TOKEN)):
        assert keyring.find(wrong) is None


def test_an_expired_key_is_not_found(keyring: Keyring, row: KeyRow) -> None:
    keyring.follow([replace(row, expires_at=datetime.now(UTC) - timedelta(seconds=1))])
    assert keyring.find(TOKEN) is None
    keyring.follow([replace(row, expires_at=datetime.now(UTC) + timedelta(hours=1))])
    assert keyring.find(TOKEN)


def test_a_revoked_key_is_not_found_and_the_keyring_is_not_empty(keyring: Keyring, row: KeyRow) -> None:
    keyring.follow([replace(row, revoked_at=datetime.now(UTC))])
    assert keyring.find(TOKEN) is None
    assert not keyring.is_empty, "or the last revocation would open the doors to everybody"


def test_following_again_gives_no_key_its_rate_back(keyring: Keyring, row: KeyRow) -> None:
    key = keyring.find(TOKEN)
    assert key is not None
    assert key.bucket is not None
    assert key.bucket.take() == 0
    keyring.follow([row])
    again = keyring.find(TOKEN)
    assert again is not None
    assert again.bucket is not None
    assert again.bucket.take() > 0
