"""Waits until every live replica follows an alias, as their acknowledgements tell."""

import time
from collections.abc import Callable
from datetime import timedelta

from league.errors import AliasMoved, NotReady
from league.registry.registry import Registry
from league.registry.rows import Acknowledgement

LOOK = 0.02
"""Seconds between two looks."""
LIVES = timedelta(seconds=15)
"""A replica that has said nothing for longer does not live any more."""


def await_followers(
    registry: Registry,
    league: str,
    alias: str,
    version: int,
    timeout: float,
    sleep: Callable[[float], None] = time.sleep,
) -> list[str]:
    """The replicas, at least one, all of which serve `version` by `alias` now. `timeout` is in seconds.

    Raises AliasMoved if the alias points elsewhere by now, or NotReady, which names who does not follow, and why.
    """
    deadline = time.monotonic() + timeout
    while True:
        now = registry.aliases(league).get(alias)
        if now != version:
            raise AliasMoved(f"{league}@{alias} has moved on to version {now} meanwhile")
        replicas = registry.replicas(LIVES)
        said = {one.replica: one for one in registry.acknowledgements(league, LIVES)}
        late = [replica for replica in replicas if not _follows(said.get(replica), alias, version)]
        if replicas and not late:
            return replicas
        if time.monotonic() >= deadline:
            reasons = [f"{replica} {_reason(said.get(replica), alias)}" for replica in late]
            moved = f"{league}@{alias} is version {version}, but after {timeout:g} s"
            raise NotReady(f"{moved} {_why(len(replicas), reasons)}")
        sleep(LOOK)


def _follows(said: Acknowledgement | None, alias: str, version: int) -> bool:
    return said is not None and said.aliases.get(alias) == version


def _why(replicas: int, reasons: list[str]) -> str:
    if not replicas:
        return "no replica has said that it serves anything: is a server running on this registry?"
    return f"{len(reasons)} of {replicas} replicas do not serve it: {'; '.join(reasons)}"


def _reason(said: Acknowledgement | None, alias: str) -> str:
    if said is None:
        return "has said nothing of this league"
    number = said.aliases.get(alias)
    serves = "serves nothing" if number is None else f"serves version {number}"
    return f"{serves} ({said.fault})" if said.fault else serves
