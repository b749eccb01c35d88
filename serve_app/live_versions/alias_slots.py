"""Holds the version that answers for each alias of each league; a hot swap replaces one reference.

alias moves → load in a thread (verify, load, warm up) → swap → the old version is freed after its last request
                                 ↘ error: the old version stays, and the error is reported
"""

import asyncio
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

from league.errors import LeagueError, NotReady, UnknownAlias
from league.refs import CHAMPION
from league.registry.storage.rows import VersionState
from serve_app.live_versions.policies import LoadedVersion
from serve_app.live_versions.version_cache import VersionCache, VersionKey
from serve_app.runtime.ray_serve import logger

Alias = tuple[str, str]
"""(league, alias)"""


@dataclass(frozen=True, slots=True, eq=False)
class _Swap:
    """The version that an alias is about to answer with."""

    number: int
    task: asyncio.Task[None]


class AliasSlots:
    """The slots of a replica. All methods run on the event loop."""

    def __init__(self, versions: VersionCache) -> None:
        self._versions = versions
        self._slots: dict[Alias, LoadedVersion] = {}
        self._wanted: dict[Alias, int] = {}
        self._answered: set[Alias] = set()
        """Aliases that have answered since the start."""
        self._faults: dict[Alias, str] = {}
        self._swaps: dict[Alias, _Swap] = {}
        self.swaps: Counter[str] = Counter()
        """league → number of hot swaps"""

    def get(self, league: str, alias: str) -> LoadedVersion | None:
        """The version that answers for an alias."""
        return self._slots.get((league, alias))

    def follow(self, league: str, alias: str) -> LoadedVersion | None:
        """The version that answers for an alias; None if the alias is new, and was not read or loaded yet.

        Raises NotReady or UnknownAlias if the alias was removed, and NotReady if its version was replaced by another
        one with the same number, which is being loaded.
        """
        version = self.get(league, alias)
        if version is not None or (league, alias) not in self._answered:
            return version
        if (league, alias) in self._wanted:
            raise NotReady(f"the version of {league}@{alias} was replaced: it is being loaded")
        if alias == CHAMPION:
            raise NotReady(f"league {league} has no champion: promote a version first")
        raise UnknownAlias(f"league {league} has no alias {alias!r}")

    def leagues(self) -> list[str]:
        """The leagues that have an alias."""
        return sorted({league for league, _ in self._wanted})

    def knows(self, league: str) -> bool:
        """Whether a league has an alias."""
        return any(league == alias_league for alias_league, _ in self._wanted)

    def champion(self, league: str) -> LoadedVersion | None:
        """The version that answers if a request names none."""
        return self.get(league, CHAMPION)

    def numbers(self) -> dict[str, dict[str, int]]:
        """league → alias → the version that answers for it."""
        numbers: dict[str, dict[str, int]] = {}
        for (league, alias), version in self._slots.items():
            numbers.setdefault(league, {})[alias] = version.number
        return numbers

    def differing(self) -> set[str]:
        """The leagues that have an alias which does not answer with the version that it names."""
        return {alias[0] for alias, number in self._wanted.items() if not self._serves(alias, number)}

    def is_served(self, alias: Alias) -> bool:
        """Whether an alias answers with the version that it names now."""
        return alias in self._wanted and self._serves(alias, self._wanted[alias])

    def faults(self) -> dict[str, str]:
        """league → why aliases of it are not served as the registry requires."""
        reasons: dict[str, list[str]] = {}
        for (league, alias), fault in sorted(self._faults.items()):
            reasons.setdefault(league, []).append(f"{alias}: {fault}")
        return {league: "; ".join(faults) for league, faults in reasons.items()}

    def loaded(self) -> set[VersionKey]:
        """The versions in memory."""
        return {(version.league, version.number) for version in self._slots.values()} | self._versions.cached_keys()

    def drop_changed(self, states: Mapping[VersionKey, VersionState | None]) -> None:
        """Stop serving versions that were removed, or replaced by others with the same numbers."""
        self._versions.drop_changed(states)
        for alias, version in list(self._slots.items()):
            key = version.league, version.number
            if key in states and ((state := states[key]) is None or state.sha256 != version.sha256):
                del self._slots[alias]

    def update(self, wanted: dict[Alias, int]) -> None:
        """Start to load the version that each alias names now, unless it is served. Each alias has its own load, which
        a later update replaces if the alias names another version by then.
        """
        self._wanted = wanted
        for gone in self._slots.keys() - wanted.keys():
            del self._slots[gone]
        for gone in self._faults.keys() - wanted.keys():
            del self._faults[gone]
        for alias, swap in list(self._swaps.items()):
            if wanted.get(alias) != swap.number:
                swap.task.cancel()
                del self._swaps[alias]
        self._keep_loaded()
        for alias, number in wanted.items():
            if alias not in self._swaps and not self._serves(alias, number):
                self._swaps[alias] = swap = _Swap(number, asyncio.create_task(self._swap(alias, number)))
                swap.task.add_done_callback(partial(self._forget, alias, swap))

    async def settle(self, timeout: float) -> None:
        """Wait until no version is being loaded, for at most `timeout` seconds."""
        if tasks := [swap.task for swap in self._swaps.values()]:
            await asyncio.wait(tasks, timeout=timeout)

    @property
    def is_settled(self) -> bool:
        """Whether the version of each alias is served, or has failed to load."""
        return all(self._serves(alias, number) or alias in self._faults for alias, number in self._wanted.items())

    def close(self) -> None:
        """Stop loading."""
        for swap in self._swaps.values():
            swap.task.cancel()

    def _forget(self, alias: Alias, swap: "_Swap", _: asyncio.Task[None]) -> None:
        if self._swaps.get(alias) is swap:
            del self._swaps[alias]

    def _keep_loaded(self) -> None:
        live = {(league, version.number) for (league, _), version in self._slots.items()}
        self._versions.pin(live | {(league, number) for (league, _), number in self._wanted.items()})

    def _serves(self, alias: Alias, number: int) -> bool:
        version = self._slots.get(alias)
        return version is not None and version.number == number and alias not in self._faults

    async def _swap(self, alias: Alias, number: int) -> None:
        league, name = alias
        try:
            version = await self._versions.get_for_alias(league, number)
        except Exception as error:  # such as MemoryError: the alias is reported, and the others are served
            self._keep(alias, number, error)
            return
        if self._slots.get(alias) is not version:
            self.swaps[league] += 1
        self._slots[alias] = version
        self._answered.add(alias)
        self._faults.pop(alias, None)
        self._keep_loaded()
        logger.info("%s@%s is now version %d", league, name, number)

    def _keep(self, alias: Alias, number: int, error: Exception) -> None:
        """Keep the version that the alias has, and report the error."""
        bug = None if isinstance(error, LeagueError) else error
        fault = error.public_message if isinstance(error, LeagueError) else f"{type(error).__name__} while loading"
        if self._faults.get(alias) == fault:
            return
        self._faults[alias] = fault
        old = self._slots.get(alias)
        stays = f"version {old.number} stays" if old else "no version is served"
        # Ray Serve buffers lower levels.
        logger.error("%s@%s cannot switch to version %d, %s: %s", *alias, number, stays, error, exc_info=bug)
