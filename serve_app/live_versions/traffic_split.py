"""Splits traffic of a league between champion and canary and between the members of mixtures, and selects the shadow.

The registry watcher reads the settings. The version of a canary or shadow has a slot like any alias; a version that is
named by number has a slot under that number, which is not a valid alias.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from random import random

from league.refs import CHAMPION
from league.registry.storage.manifest import episode_position
from league.registry.storage.rows import Portion
from league.registry.storage.rows import Traffic as Setting
from serve_app.live_versions.alias_slots import Alias, AliasSlots
from serve_app.live_versions.policies import LoadedVersion

KEY = b"x-league-key"
"""Header that names what must stay with one version, such as a player or an episode."""
CANARY = b""
"""The purpose of positions that decide about a canary."""
Headers = Iterable[tuple[bytes, bytes]]


class TrafficSplit:
    """The traffic settings that a replica applies. They are changed on the event loop, and read by the shadow, too."""

    def __init__(self, slots: AliasSlots) -> None:
        self._slots = slots
        self._settings: dict[str, Setting] = {}
        self.canaries: dict[str, Portion] = {}
        """league → its canary"""
        self.shadows: dict[str, Portion] = {}
        """league → its shadow"""
        self.canary_requests: Counter[tuple[str, int]] = Counter()
        """(league, version) → requests answered as canary"""

    def update(self, settings: Mapping[str, Setting]) -> None:
        """Apply these settings from now on."""
        self._settings = dict(settings)
        self.canaries = _active({league: setting.canary for league, setting in settings.items()})
        self.shadows = _active({league: setting.shadow for league, setting in settings.items()})

    def applied_setting(self, league: str) -> int | None:
        """The id of the league's setting, once all versions that it names are loaded."""
        setting = self._settings.get(league)
        if setting is None or any(not self._slots.is_served(slot) for slot in slots(setting)):
            return None
        return setting.id

    def differing(self) -> set[str]:
        """The leagues whose setting names a version that is not loaded."""
        return {league for league in self._settings if self.applied_setting(league) is None}

    def route(self, champion: LoadedVersion, headers: Headers) -> LoadedVersion:
        """The version that answers a request for a champion: the champion, or the canary if the caller's key is in its
        share.

        A key keeps its side while the share is unchanged, and a larger share only adds keys.
        """
        league, canary = champion.league, self.serving(self.canaries, champion.league)
        key = None if canary is None else key_of(headers)
        if canary is None or key is None or episode_position(league, key, CANARY) >= self.canaries[league].share:
            return champion
        self.canary_requests[league, acting(canary, headers).number] += 1
        return canary

    def serving(self, portions: Mapping[str, Portion], league: str) -> LoadedVersion | None:
        """The loaded version of a portion of a league, if it has one: of `canaries` or of `shadows`."""
        portion = portions.get(league)
        return None if portion is None else self._slots.get(league, str(portion.version))


def key_of(headers: Headers) -> bytes | None:
    """The caller's key."""
    return next((value for name, value in headers if name == KEY), None)


def acting(version: LoadedVersion, headers: Headers) -> LoadedVersion:
    """The version that acts: of a mixture, the member that the caller's key selects, and a random one without a key."""
    if version.mixture is None:
        return version
    key = key_of(headers)
    position = random() if key is None else episode_position(version.league, key)
    return version.members[version.mixture.index_at(position)]


def slots(setting: Setting) -> dict[Alias, int | None]:
    """The slots that a setting requires → the number of a version that only the setting names."""
    portions = [portion for portion in (setting.canary, setting.shadow) if portion is not None]
    return {
        (setting.league, str(portion.version)): portion.version if isinstance(portion.version, int) else None
        for portion in portions
    }


def pinned_slots(settings: Mapping[str, Setting]) -> dict[Alias, int]:
    """The slots of versions that settings name by number."""
    needed = (slots(setting) for setting in settings.values())
    return {slot: number for setting_slots in needed for slot, number in setting_slots.items() if number is not None}


def _active(portions: Mapping[str, Portion | None]) -> dict[str, Portion]:
    return {
        league: portion
        for league, portion in portions.items()
        if portion is not None and portion.share and portion.version != CHAMPION
    }
