"""Which addresses other machines can reach."""

import pytest

from serve_app.settings import is_exposed


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "::1", "[::1]"])
def test_loopback_addresses_are_not_exposed(host: str) -> None:
    assert not is_exposed(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1", "192.168.1.2", "example.org", "", "localhost.evil"])
def test_all_other_addresses_are_exposed(host: str) -> None:
    assert is_exposed(host)
