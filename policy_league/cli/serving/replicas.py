"""`league replicas`: the serving replicas that promotions wait for."""

from typing import Annotated

import typer

from league.errors import Conflict, NotFound
from policy_league.cli.options import AsJson, open_registry
from policy_league.cli.output import emit, say, table


def replicas(
    remove: Annotated[
        str | None, typer.Option(metavar="REPLICA", help="Remove a replica whose machine is gone for good.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the serving replicas, or remove one that has ended.

    Commands with --wait wait for each of these replicas. A replica deregisters when it stops; one that was killed is
    removed by the others on its machine or in its Ray cluster after 15 seconds, or else after a day. One that is silent
    but has not ended may still serve an old version.
    """
    from league.registry.replicas import LIVENESS_TIMEOUT, URL

    repository = open_registry().replicas
    registrations = {registration.replica: registration for registration in repository.registered()}
    if remove is not None:
        if remove not in registrations:
            raise NotFound(f"there is no replica {remove!r}; known: {', '.join(registrations) or 'none'}")
        if (silence := registrations[remove].silence) < LIVENESS_TIMEOUT:
            raise Conflict(f"replica {remove} reported {silence.total_seconds():.0f} s ago: stop it instead")
        repository.remove(remove)
        say(f"Removed replica {remove}.")
        return
    if as_json:
        emit(
            {
                "replicas": [
                    {
                        "replica": registration.replica,
                        "seen_at": registration.seen_at,
                        "silent_seconds": registration.silence.total_seconds(),
                        "silent": registration.silence >= LIVENESS_TIMEOUT,
                        "url": registration.process.get(URL),
                    }
                    for registration in registrations.values()
                ]
            }
        )
        return
    rows = [
        (
            registration.replica,
            registration.seen_at,
            "silent" if registration.silence >= LIVENESS_TIMEOUT else "reports",
            registration.process.get(URL, ""),
        )
        for registration in registrations.values()
    ]
    table(("replica", "last report", "state", "URL on its machine"), rows)
