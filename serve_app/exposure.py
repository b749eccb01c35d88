"""Whether other machines can reach a server."""

from ipaddress import ip_address


def is_exposed(host: str) -> bool:
    """Whether an address to listen on is not the loopback interface's."""
    if host == "localhost":
        return False
    try:
        return not ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return True  # a name may be anybody's


def serves_other_machines() -> bool:
    """Whether the Ray Serve of this replica listens to other machines.

    A replica listens where its HAProxy does: at `host` of the HTTP options, which the controller knows.
    """
    from ray.serve.context import _get_global_client

    return is_exposed(_get_global_client().http_config.host)
