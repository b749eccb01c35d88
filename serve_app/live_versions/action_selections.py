"""How the versions of each league select actions if a request does not say."""

from collections.abc import Mapping

from league.conditions import ActionSelection


class ActionSelections:
    """The action selection of each league. All versions of a league share it, so that a change reaches all at once."""

    def __init__(self) -> None:
        self._selections: dict[str, ActionSelection] = {}

    def update(self, registered: Mapping[str, ActionSelection]) -> None:
        """Follow what is registered now."""
        self._selections.update(registered)

    def add(self, league: str, selection: ActionSelection) -> None:
        """Add a league of which a version is loaded, unless it is known. Called in any thread."""
        self._selections.setdefault(league, selection)

    def is_sampled(self, league: str) -> bool:
        """Whether the versions of a league sample their actions, as in its matches."""
        return self._selections[league] == "sampled"
