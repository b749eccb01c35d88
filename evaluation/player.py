"""What one process needs to play matches of a league: its environment copies, and a bounded cache of contestants."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from functools import lru_cache

from evaluation.deadline import Deadline
from evaluation.play import Roster, play
from league.config import LeagueConfig
from league.environments.building import interface
from league.environments.lockstep import stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch
from league.policies.loading import contestant
from league.policies.pinning import check_eligible
from league.policies.policy import Policy
from league.registry.registry import Registry
from league.results.records import Match, Schedule
from league.settings import Storage

MOST_CONTESTANTS = 64
"""Contestants kept loaded in one process."""


class Player:
    """Plays matches of one league. Not for several threads at once."""

    def __init__(self, config: LeagueConfig, registry: Registry) -> None:
        self.config = config
        self.interface = interface(config)
        self._registry = registry
        self._environment: BatchedEnvironment | None = None
        self._contestants: OrderedDict[str, dict[str, tuple[str, Policy]]] = OrderedDict()

    def play(self, schedule: Schedule, positions: Iterable[int], *, expendable: bool = False) -> list[Match]:
        """The matches at `positions`, in that order.

        expendable: whether this process may end where nothing else ends a game that hangs: see deadline.py.
        Raises EnvironmentMismatch if the schedule is of another environment, and what `play.play` and loading raise.
        """
        if schedule.environment_digest != self.config.environment.digest():
            raise EnvironmentMismatch(
                f"schedule {schedule.id} was drawn up for another environment than league {schedule.league} has now"
            )
        positions = list(positions)
        refs = dict.fromkeys(ref for position in positions for ref in schedule.contestants_at(position))
        roster: Roster = {ref: self.contestant(ref) for ref in refs}
        seated = self.interface.apart() if schedule.scoring == "team" else self.interface
        settings = self.config.play
        deadline = Deadline(settings.game_seconds, expendable)
        environment = self._environment or stepping(self.config.environment, settings.copies)
        # What was interrupted anywhere is not used again, nor closed: that may hang, too.
        self._environment = None
        matches = play(schedule, positions, environment, seated, roster, settings.max_moves, deadline)
        self._environment = environment
        return matches

    def contestant(self, ref: str) -> dict[str, tuple[str, Policy]]:
        """agent → (policy id, policy) of a pinned reference, loaded and verified once.

        Raises what loading does, and EnvironmentMismatch for a version that was trained in another environment.
        """
        if ref not in self._contestants:
            check_eligible(ref, self._registry, self.config)
            self._contestants[ref] = contestant(ref, self._registry, self.interface)
        self._contestants.move_to_end(ref)
        if len(self._contestants) > MOST_CONTESTANTS:
            self._contestants.popitem(last=False)
        return self._contestants[ref]


@lru_cache(maxsize=4)
def player(storage: Storage, config: str) -> Player:
    """This process's player of the league whose configuration is `config`, a JSON document."""
    return Player(LeagueConfig.model_validate_json(config), Registry.open(storage))
