"""What is live: for each alias of each league, the version that answers. A swap replaces one reference.

the alias moves → stage (in a thread: verify, load, warm) → swap → the old one goes with its last request
                                     ↘ fault: the old one stays, the fault is kept and told
"""

import asyncio
import logging
from collections import Counter

from league.errors import LeagueError
from league.refs import CHAMPION
from serve_app.loading import LoadedVersion
from serve_app.versions import Versions

# A child of Serve's logger, so that it reaches the replica's log file whatever level Serve itself logs at.
logger = logging.getLogger("ray.serve.policy_league")
logger.setLevel(logging.INFO)

Alias = tuple[str, str]
"""(league, alias)"""


class Live:
    """The live slots of a replica. All methods run on the event loop."""

    def __init__(self, versions: Versions) -> None:
        self._versions = versions
        self._slots: dict[Alias, LoadedVersion] = {}
        self._wanted: dict[Alias, int] = {}
        self._faults: dict[Alias, str] = {}
        self.swaps: Counter[str] = Counter()
        """league → how often one of its slots got another version"""

    def get(self, league: str, alias: str) -> LoadedVersion | None:
        """What answers for an alias."""
        return self._slots.get((league, alias))

    def leagues(self) -> list[str]:
        """The leagues that have an alias."""
        return sorted({league for league, _ in self._wanted})

    def knows(self, league: str) -> bool:
        """Whether a league has an alias."""
        return any(league == known for known, _ in self._wanted)

    def champion(self, league: str) -> LoadedVersion | None:
        """What answers where no version is asked for."""
        return self.get(league, CHAMPION)

    def numbers(self, league: str) -> dict[str, int]:
        """alias → the version that answers for it."""
        return {alias: version.number for (of, alias), version in self._slots.items() if of == league}

    def is_served(self, alias: Alias) -> bool:
        """Whether an alias answers from the version that it names now."""
        return alias in self._wanted and self._serves(alias, self._wanted[alias])

    def fault(self, league: str) -> str | None:
        """Why the league's aliases are not all served as they should be."""
        faults = {alias: fault for (of, alias), fault in self._faults.items() if of == league}
        return "; ".join(f"{alias}: {fault}" for alias, fault in sorted(faults.items())) or None

    async def follow(self, wanted: dict[Alias, int]) -> None:
        """Make every alias answer from the version that it names now, as far as that can be loaded."""
        self._wanted = wanted
        for gone in self._slots.keys() - wanted.keys():
            del self._slots[gone]
        for gone in self._faults.keys() - wanted.keys():
            del self._faults[gone]
        self._keep_loaded()
        late = [alias for alias, number in wanted.items() if not self._serves(alias, number)]
        await asyncio.gather(*(self._swap(alias, wanted[alias]) for alias in late))
        self._keep_loaded()

    def _keep_loaded(self) -> None:
        live = {(league, version.number) for (league, _), version in self._slots.items()}
        self._versions.keep(live | {(league, number) for (league, _), number in self._wanted.items()})

    def _serves(self, alias: Alias, number: int) -> bool:
        version = self._slots.get(alias)
        return version is not None and version.number == number and alias not in self._faults

    async def _swap(self, alias: Alias, number: int) -> None:
        league, name = alias
        try:
            version = await self._versions.get(league, number)
        except LeagueError as error:
            self._stay(alias, number, str(error))
            return
        if self._slots.get(alias) is not version:
            self.swaps[league] += 1
        self._slots[alias] = version
        self._faults.pop(alias, None)
        logger.info("%s@%s is now version %d", league, name, number)

    def _stay(self, alias: Alias, number: int, reason: str) -> None:
        if self._faults.get(alias) == reason:
            return
        self._faults[alias] = reason
        old = self._slots.get(alias)
        stays = f"version {old.number} stays" if old else "nothing is served"
        # An error, because Serve buffers anything less.
        logger.error("%s@%s cannot go to version %d, %s: %s", *alias, number, stays, reason)
