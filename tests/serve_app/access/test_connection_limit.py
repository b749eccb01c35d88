import resource
from contextlib import ExitStack
from datetime import UTC, datetime

import pytest

from league.errors import Overloaded
from league.registry.storage.rows import KeyRow
from serve_app.access.api_keys import ApiKey
from serve_app.access.connection_limit import ConnectionLimit, within_descriptors


def key(name: str) -> ApiKey:
    now = datetime.now(UTC)
    row = KeyRow(
        id=name, name=name, sha256="00" * 32, scopes=frozenset(("act",)), leagues=None, rate=None,
        created_at=now, expires_at=None, revoked_at=None,
    )  # fmt: skip
    return ApiKey(row, None)


def test_connections_are_limited_in_total_and_per_key() -> None:
    limit, one, other = ConnectionLimit("streams", 5, 2), key("one"), key("other")
    with ExitStack() as stack:
        for opened in (one, one, other, None):
            stack.enter_context(limit.opened(opened))
        with pytest.raises(Overloaded, match="2 streams of the key one are open in this replica"), limit.opened(one):
            pass
        stack.enter_context(limit.opened(other))
        with pytest.raises(Overloaded, match="5 streams are open in this replica"), limit.opened(None):
            pass
        assert limit.open == 5
    assert limit.open == 0
    with limit.opened(one), limit.opened(one):
        assert limit.open == 2


def test_a_connection_that_fails_is_not_counted_any_more() -> None:
    limit = ConnectionLimit("streams", 1, 1)
    for _ in range(3):
        with pytest.raises(ZeroDivisionError), limit.opened(key("one")):
            raise ZeroDivisionError
    assert limit.open == 0


def test_connections_leave_file_descriptors_for_the_rest_of_the_process() -> None:
    descriptors, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert within_descriptors(2) == 2
    assert within_descriptors(descriptors) < descriptors
