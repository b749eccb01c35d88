"""Who calls: gRPC's name of a peer, and whether it is on this machine."""

from functools import lru_cache
from ipaddress import IPv6Address, ip_address
from urllib.parse import unquote


@lru_cache(maxsize=1024)  # a connection has one name
def is_of(peer: str, machine: str) -> bool:
    """Whether a peer is on a machine: `ipv4:127.0.0.1:4711`, `ipv6:%5B::1%5D:4711` or `unix:` is on any."""
    kind, _, rest = unquote(peer).partition(":")
    if kind == "unix":
        return True
    try:
        address = ip_address(rest.rpartition(":")[0].strip("[]"))
    except ValueError:
        return False
    if isinstance(address, IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return address.is_loopback or str(address) == machine
