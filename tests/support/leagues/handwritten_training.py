"""A trainer that publishes handwritten versions of tic-tac-toe."""

from collections.abc import Callable

from league.config.league import LeagueConfig
from league.registry.registry import Registry
from tests.support.leagues import tictactoe
from tests.support.leagues.tictactoe import LEAGUE


class HandwrittenTrainer:
    """Publishes one version for each new run, as training that resumes does: once for each name.

    choose: returns the graph, from the number of versions and the target of an exploiter.
    """

    def __init__(self, registry: Registry, choose: Callable[[int, str | None], bytes]) -> None:
        self._registry, self._choose = registry, choose
        self.calls: list[tuple[str, int | None, str | None]] = []

    def __call__(self, config: LeagueConfig, *, name: str, parent: int | None, target: str | None) -> None:
        self.calls.append((name, parent, target))
        rows, runs = self._registry.versions.all(LEAGUE), self._registry.runs
        if name in {row.run for row in rows}:
            return
        settings = config.training.model_dump(mode="json", by_alias=True)
        seed = config.training.seed
        runs.begin(LEAGUE, name, algorithm="ppo", settings=settings, seed=seed, target=100, parent=parent)
        graph = self._choose(len(rows), target)
        tictactoe.publish(self._registry, graph, exploits=target, source=f"{name}/100", settings=settings)
        runs.end(LEAGUE, name, "ended")
