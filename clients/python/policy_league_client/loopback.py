"""Which hosts are this machine. Imports nothing: every process of a server decides it."""

from ipaddress import ip_address


def is_loopback(host: str) -> bool:
    """Return whether a host in lower case, without brackets, is this machine: `localhost`, `127.0.0.1`, `::1`."""
    if host == "localhost" or host.endswith(".localhost"):  # never resolved by DNS (RFC 6761)
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
