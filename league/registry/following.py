"""Waits until every live replica follows an alias or a setting of traffic, as their acknowledgements tell."""

import time
from collections.abc import Callable
from datetime import timedelta

from league.errors import AliasMoved, Conflict, NotReady
from league.registry.registry import Registry
from league.registry.rows import Acknowledgement, Traffic

LOOK = 0.02
"""Seconds between two looks."""
SILENT = "has said nothing of this league"
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

    def check() -> None:
        if (now := registry.aliases(league).get(alias)) != version:
            raise AliasMoved(f"{league}@{alias} has moved on to version {now} meanwhile")

    return _await(
        registry,
        league,
        f"{league}@{alias} is version {version}",
        check=check,
        follows=lambda said: said.aliases.get(alias) == version,
        tell=lambda said: _serves(said, alias),
        timeout=timeout,
        sleep=sleep,
    )


def await_traffic(
    registry: Registry, setting: Traffic, timeout: float, sleep: Callable[[float], None] = time.sleep
) -> list[str]:
    """The replicas, at least one, all of which follow a setting of traffic now. `timeout` is in seconds.

    Raises Conflict if there is a newer setting by now, or NotReady, which names who does not follow, and why.
    """

    def check() -> None:
        if registry.traffic(setting.league).id != setting.id:
            raise Conflict(f"the traffic of {setting.league} was set otherwise meanwhile")

    return _await(
        registry,
        setting.league,
        f"the traffic of {setting.league} is set",
        check=check,
        follows=lambda said: said.traffic == setting.id,
        tell=lambda said: said.fault or "has not followed",
        timeout=timeout,
        sleep=sleep,
    )


def _await(
    registry: Registry,
    league: str,
    done: str,
    *,
    check: Callable[[], None],
    follows: Callable[[Acknowledgement], bool],
    tell: Callable[[Acknowledgement], str],
    timeout: float,
    sleep: Callable[[float], None],
) -> list[str]:
    """The replicas, once all follow. `check` raises when that is in vain; `tell` says why one does not."""
    deadline = time.monotonic() + timeout
    while True:
        check()
        replicas = registry.replicas(LIVES)
        said = {one.replica: one for one in registry.acknowledgements(league, LIVES)}
        late = [replica for replica in replicas if replica not in said or not follows(said[replica])]
        if replicas and not late:
            return replicas
        if time.monotonic() >= deadline:
            reasons = [f"{replica} {tell(said[replica]) if replica in said else SILENT}" for replica in late]
            raise NotReady(f"{done}, but after {timeout:g} s {_why(len(replicas), reasons)}")
        sleep(LOOK)


def _why(replicas: int, reasons: list[str]) -> str:
    if not replicas:
        return "no replica has said that it serves anything: is a server running on this registry?"
    return f"{len(reasons)} of {replicas} replicas do not serve it: {'; '.join(reasons)}"


def _serves(said: Acknowledgement, alias: str) -> str:
    number = said.aliases.get(alias)
    serves = "serves nothing" if number is None else f"serves version {number}"
    return f"{serves} ({said.fault})" if said.fault else serves
