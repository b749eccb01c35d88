"""Which addresses other machines reach."""

import pytest

from serve_app.exposure import is_exposed


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "localhost", "::1", "[::1]"])
def test_the_loopback_interface_is_this_machines(host: str) -> None:
    assert not is_exposed(host)


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.1", "192.168.1.2", "example.org", "", "localhost.evil"])
def test_everything_else_is_not(host: str) -> None:
    assert is_exposed(host)
