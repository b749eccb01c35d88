"""Per-process state for playing matches of a league: environments and a bounded cache of loaded contestants."""

from __future__ import annotations

import gc
from collections import OrderedDict
from collections.abc import Iterable
from types import MappingProxyType

from evaluation.matches.game_loop import play_matches
from evaluation.matches.seating import Roster
from evaluation.matches.watchdog import Deadline, close_in_time
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.copies import StockCopies
from league.environments.implementation import STOCK_ENVS, VECTOR_ENVS, implementation, stepping
from league.environments.stepping import BatchedEnvironment
from league.errors import EnvironmentMismatch
from league.policies.loading import check_eligible
from league.policies.policy import Policy
from league.refs import CheckpointRef, parse_ref
from league.registry.gateways import ForSimulators
from league.registry.registry import Registry
from league.registry.storage.manifest import Mixture
from league.results.records import Match, Schedule
from league.search.policies import contestant
from league.settings import Storage

MOST_CONTESTANTS = 64
"""Contestants that stay loaded in one process."""
MOST_WORKERS = 4
"""Leagues whose environments and contestants stay loaded in one process."""
_workers: OrderedDict[tuple[Storage, str], MatchWorker] = OrderedDict()


class MatchWorker:
    """Plays matches of one league. Not thread-safe.

    Its environment is created for the first matches, and closed at the end of a schedule by whoever plays it.
    """

    def __init__(self, config: LeagueConfig, registry: Registry) -> None:
        self.config = config
        self.interface = interface(config)
        self._registry = registry
        self._environment: BatchedEnvironment | None = None
        self._contestants: OrderedDict[str, dict[str, tuple[str, Policy]]] = OrderedDict()
        self._mixtures: dict[str, Mixture | None] = {}
        # Games create many objects. Without freezing, each collection would traverse everything that is loaded.
        gc.freeze()

    def play(
        self,
        schedule: Schedule,
        positions: Iterable[int],
        *,
        expendable: bool = False,
        guests: Roster = MappingProxyType({}),
    ) -> list[Match]:
        """Play the matches at `positions`, in that order.

        expendable: whether this process may exit to end a game that hangs: see watchdog.py.
        guests: contestants of the schedule that are not in the registry.
        Raises EnvironmentMismatch if the schedule is for another environment, and the errors of `play_matches` and of
        loading.
        """
        if schedule.game_digest != self.config.game_digest():
            raise EnvironmentMismatch(
                f"schedule {schedule.id} was created for another game than league {schedule.league} has now: its"
                " environment's settings or code, a library or the rules of play have changed"
            )
        positions = list(positions)
        refs = dict.fromkeys(ref for position in positions for ref in schedule.contestants_at(position))
        mixtures = {ref: mixture for ref in refs if ref not in guests and (mixture := self._mixture(ref)) is not None}
        members = [f"{schedule.league}@{number}" for mixture in mixtures.values() for number in mixture.versions]
        playing = dict.fromkeys([*(ref for ref in refs if ref not in mixtures), *members])
        roster: Roster = {ref: guests[ref] if ref in guests else self.contestant(ref) for ref in playing}
        seated = self.interface.apart() if schedule.scoring == "team" else self.interface
        settings = self.config.play
        deadline = Deadline(settings.game_seconds, expendable)
        environment = self._environment = self._environment or stepping(
            self.config.environment,
            num_envs(self.config),
            simulators=ForSimulators(self._registry.storage, self.config.league),
        )
        try:
            return play_matches(
                schedule, positions, environment, seated, roster, settings.max_moves, deadline, mixtures
            )
        except BaseException:
            self._discard_environment(expendable)  # it must not be used again
            raise

    def close_environment(self, expendable: bool = False) -> None:
        """Close the environment, and create another one for the next matches. expendable: see `play`."""
        # A vectorised one has nothing to close, and simulators stay connected.
        if isinstance(getattr(self._environment, "copies", None), StockCopies):
            self._discard_environment(expendable)

    def _discard_environment(self, expendable: bool) -> None:
        environment, self._environment = self._environment, None
        if environment is not None:
            close_in_time(environment, expendable)

    def close(self) -> None:
        """Close the environment and the connections to the registry."""
        self._discard_environment(expendable=False)
        self._registry.close()

    def _mixture(self, ref: str) -> Mixture | None:
        """The members of a fixed reference, if it is a mixture."""
        if ref not in self._mixtures:
            parsed = parse_ref(ref)
            if isinstance(parsed, CheckpointRef):
                self._mixtures[ref] = self._registry.versions.resolve(parsed).mixture
            else:
                self._mixtures[ref] = None
        return self._mixtures[ref]

    def contestant(self, ref: str) -> dict[str, tuple[str, Policy]]:
        """agent → (policy id, policy) of a fixed reference, loaded and verified once.

        Raises loading errors, and EnvironmentMismatch for a version trained in another environment.
        """
        if ref not in self._contestants:
            check_eligible(ref, self._registry, self.config)
            self._contestants[ref] = contestant(ref, self._registry, self.interface, self.config.environment)
        self._contestants.move_to_end(ref)
        if len(self._contestants) > MOST_CONTESTANTS:
            self._contestants.popitem(last=False)
        return self._contestants[ref]


def num_envs(config: LeagueConfig) -> int:
    """Return the number of games that a worker steps in parallel."""
    if config.play.num_envs != "auto":
        return config.play.num_envs
    return STOCK_ENVS if implementation(config.environment).vector is None else VECTOR_ENVS


def match_worker(storage: Storage, config: str) -> MatchWorker:
    """This process's worker for the league with this configuration, a JSON document. Not thread-safe."""
    key = storage, config
    worker = _workers.get(key) or MatchWorker(LeagueConfig.model_validate_json(config), Registry.open(storage))
    _workers[key] = worker
    _workers.move_to_end(key)
    if len(_workers) > MOST_WORKERS:
        # Frozen objects are not collected: its connections would stay open.
        _workers.popitem(last=False)[1].close()
    return worker
