"""Which version answers a request for a champion where a canary is set, and which one it is shown to afterwards.

Settings come from the registry with its aliases (alias_watcher.py). The version of a canary or shadow has a live slot
as every alias has; one that is named by number has a slot under that number, which no alias can be called.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from league.refs import CHAMPION
from league.registry.rows import Portion
from league.registry.rows import Traffic as Setting
from serve_app.live import Alias, Live
from serve_app.loading import LoadedVersion

KEY = b"x-league-key"
"""The header by which a caller says what must stay with one version: a player, an episode."""
Headers = Iterable[tuple[bytes, bytes]]


class Side(NamedTuple):
    """A live slot and its share of requests."""

    slot: str
    share: float


class Traffic:
    """The settings that a replica follows. All methods run on the event loop."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._settings: dict[str, Setting] = {}
        self.canaries: dict[str, Side] = {}
        """league → its canary; empty where there is none, so that asking costs nothing."""
        self.shadows: dict[str, Side] = {}
        """league → its shadow"""
        self.canaried: Counter[tuple[str, int]] = Counter()
        """(league, version) → requests that it answered as canary"""

    def follow(self, settings: Mapping[str, Setting]) -> None:
        """Follow these settings from now on."""
        self._settings = dict(settings)
        self.canaries = _sides({league: setting.canary for league, setting in settings.items()})
        self.shadows = _sides({league: setting.shadow for league, setting in settings.items()})

    def followed(self, league: str) -> int | None:
        """The id of the league's setting, once all that it names is loaded."""
        setting = self._settings.get(league)
        if setting is None or any(not self._live.is_served(slot) for slot in slots(setting)):
            return None
        return setting.id

    def answering(self, champion: LoadedVersion, headers: Headers) -> LoadedVersion:
        """Who answers a request for a champion: it, or the canary if the caller's key is among its share."""
        league = champion.league
        side = self.canaries.get(league)
        if side is None:
            return champion
        key = next((value for name, value in headers if name == KEY), None)
        if key is None or position(league, key) >= side.share:
            return champion
        canary = self._live.get(league, side.slot)
        if canary is None:
            return champion
        self.canaried[league, canary.number] += 1
        return canary


def slots(setting: Setting) -> dict[Alias, int | None]:
    """The live slots that a setting needs, and the number of a version that has none but by the setting."""
    portions = [portion for portion in (setting.canary, setting.shadow) if portion is not None]
    return {
        (setting.league, str(portion.version)): portion.version if isinstance(portion.version, int) else None
        for portion in portions
    }


def pinned(settings: Mapping[str, Setting]) -> dict[Alias, int]:
    """The slots of versions that settings name by number."""
    needed = (slots(setting) for setting in settings.values())
    return {slot: number for each in needed for slot, number in each.items() if number is not None}


def position(league: str, key: bytes) -> float:
    """Where a key stands among all keys of a league, in [0, 1): those below a canary's share are its own.

    It depends on nothing else, so a key stays on its side while the share stays, and a greater share only adds keys.
    """
    digest = hashlib.blake2b(league.encode() + b"\0" + key, digest_size=8).digest()
    return int.from_bytes(digest[:6], "big") / 2**48  # a double holds it exactly, so that 1 is never reached


def _sides(portions: Mapping[str, Portion | None]) -> dict[str, Side]:
    return {
        league: Side(str(portion.version), portion.share)
        for league, portion in portions.items()
        if portion is not None and portion.share and portion.version != CHAMPION
    }
