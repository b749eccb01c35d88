"""Which peers are local."""

import pytest

from serve_app.inference_protocol.grpc_service import is_local_peer


@pytest.mark.parametrize(
    ("peer", "is_here"),
    [
        ("ipv4:127.0.0.1:4711", True),
        ("ipv4:127.8.0.1:4711", True),
        ("ipv6:[::1]:4711", True),
        ("ipv6:%5B::1%5D:4711", True),
        ("ipv6:[::ffff:127.0.0.1]:4711", True),
        ("ipv4:192.0.2.1:4711", True),
        ("ipv6:[::ffff:192.0.2.1]:4711", True),
        ("unix:", True),
        ("unix:/run/socket", True),
        ("ipv4:192.0.2.2:4711", False),
        ("ipv6:[2001:db8::1]:4711", False),
        ("ipv6:[::ffff:192.0.2.2]:4711", False),
        ("ipv4:127.0.0.1", False),
        ("", False),
        ("localhost", False),
    ],
)
def test_local_and_remote_peers(peer: str, is_here: bool) -> None:
    assert is_local_peer(peer, "192.0.2.1") is is_here
