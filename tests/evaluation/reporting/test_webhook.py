"""The webhook of nightly runs and proxies. Its deliveries are tested with `league nightly`."""

import pytest

from evaluation.reporting.webhook import deliver
from league.errors import InvalidInput, RemoteError


def test_no_proxy_is_used_for_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", "unknown://127.0.0.1")
    with pytest.raises(RemoteError, match="Connection refused"):
        deliver("http://127.0.0.1:9", [], [])
    with pytest.raises(InvalidInput, match="the proxy that ALL_PROXY names cannot be used"):
        deliver("http://chat.example", [], [])
