"""The opponents that a run draws from the versions of its league.

The learner's scores are those of its training games. They decay, because the learner changes, and are shrunk towards a
prior: ½, or the parent version's score in the league's matches. Shares of the episodes are counted apart from them,
since the games of some leagues are not scored. A version that the run publishes becomes a candidate;
the learner's scores at its checkpoint become its row of the payoff matrix.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from math import isnan
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ray.rllib.utils.metrics import NUM_EPISODES

from league.config.league import LeagueConfig
from league.config.opponents import OpponentConfig
from league.interface import Interface
from league.random.seeds import generator
from league.registry.registry import Registry
from league.results.ledger import Ledger
from league.results.payoffs import UNKNOWN, Scores, payoff_matrix, shrunk
from league.results.sums import outcomes, whole
from league.settings import Storage
from training.algorithms.opponent_distribution import opponent_distribution, systematic_counts
from training.sampling.self_play import EPISODES, GAMES, OPPONENTS, SCORE

HALF_LIFE = 200_000
"""Actions of all agents after which an episode or a game counts half."""
LEAST_EPISODES = 0.01
"""Episodes, after this decay, below which an opponent is forgotten."""


class LeagueOpponents:
    """The candidates, the learner's scores against them, and the opponents that are active until the next update."""

    def __init__(self, league: LeagueConfig, interface: Interface, storage: Storage | None) -> None:
        """Without a storage, there are no candidates."""
        self._league, self._interface, self._storage = league, interface, storage
        self._settings = league.training.opponents.league
        self.active: tuple[OpponentConfig, ...] = ()
        """The opponents of new episodes, with their shares."""
        self.candidates: tuple[str, ...] = ()
        """Versions by age, the newest last."""
        self._scores: Scores = {}
        self._episodes: dict[str, float] = {}
        self._all_episodes = 0.0
        self._priors: dict[str, float] = {}
        self._rows: dict[str, Scores] = {}
        self._unpublished: dict[str, Scores] = {}
        self._inherited: Scores = {}
        self._payoff: NDArray[np.float64] = np.zeros((0, 0))
        self.reset(0)

    def reset(self, steps: int) -> None:
        """Draw the active opponents. Further draws depend on the state, the run's seed, and `steps` only."""
        self._rng = generator(self._league.training.seed, OPPONENTS, steps)
        self.draw()

    def draw(self) -> None:
        """Draw the active opponents."""
        settings = self._settings
        if settings is None or not self.candidates:
            self.active = ()
            return
        p = opponent_distribution(settings, [self.score(ref) for ref in self.candidates], self._payoff)
        counts = systematic_counts(p, settings.active, self._rng)
        self.active = tuple(
            OpponentConfig(ref=ref, share=settings.share * count / settings.active)
            for ref, count in zip(self.candidates, counts.tolist(), strict=True)
            if count
        )

    def score(self, ref: str) -> float:
        """Return the estimated probability that the learner beats an opponent."""
        games, score = self._scores.get(ref, (0.0, 0.0))
        return shrunk(games, score, self._priors.get(ref, UNKNOWN))

    def scores(self) -> dict[str, float]:
        """Return the score against each opponent of whose recent episodes some were scored."""
        return {ref: self.score(ref) for ref in self._scores}

    def shares(self) -> dict[str, float]:
        """Return each opponent's share of the recent episodes, without those that were not drawn for long."""
        return {ref: episodes / max(self._all_episodes, 1.0) for ref, episodes in self._episodes.items()}

    def add(self, results: Sequence[Mapping[str, Any]], actions: int) -> None:
        """Add the episodes in the metrics of all runners, and the games against opponents among them.

        actions: of all agents since the last call.
        """
        decay = 0.5 ** (actions / HALF_LIFE)
        self._all_episodes *= decay
        decayed = {ref: episodes * decay for ref, episodes in self._episodes.items()}
        self._episodes = {ref: episodes for ref, episodes in decayed.items() if episodes >= LEAST_EPISODES}
        scores = self._scores.items()
        self._scores = {ref: (games * decay, score * decay) for ref, (games, score) in scores if ref in self._episodes}
        for result in results:
            self._all_episodes += float(result[NUM_EPISODES])
            for ref, values in result.get(OPPONENTS, {}).items():
                episodes, new, won = (float(values[name]) for name in (EPISODES, GAMES, SCORE))
                if isnan(episodes) or not episodes:
                    continue  # RLlib keeps the keys of earlier updates.
                self._episodes[ref] = self._episodes.get(ref, 0.0) + episodes
                if new:
                    games, score = self._scores.get(ref, (0.0, 0.0))
                    self._scores[ref] = games + new, score + won

    def refresh(self, *, checkpoint: str | None = None, parent: int | None = None) -> None:
        """Read the candidates and their results from the registry.

        Args:
            checkpoint: The source of the version that the current state will be published as.
            parent: The version that training started from.
        """
        settings = self._settings
        if settings is None or self._storage is None:
            return
        with closing(Registry.open(self._storage)) as registry:
            rows = self._versions(registry)
            self.candidates = tuple(rows)
            reads_results = parent is not None or settings.sampling in ("nash", "alpha_rank")
            conditions = registry.leagues.get(self._league.league).conditions
            ledger, league = Ledger(registry), self._league.league
            sums = ledger.sums(league, ledger.counted(league, conditions)) if reads_results else {}
        results = list(outcomes(whole(sums)))
        for ref, source in rows.items():
            if source in self._unpublished:
                self._rows[ref] = self._unpublished.pop(source)
        self._rows = {ref: row for ref, row in self._rows.items() if ref in rows}
        if parent is not None and checkpoint is None:
            # What the run of the parent has found becomes the prior of this one.
            self._inherited = self._scores
            self._episodes, self._all_episodes, self._scores = {}, 0.0, {}
        if checkpoint is not None:
            self._unpublished[checkpoint] = dict(self._scores)
        self._payoff = payoff_matrix(self.candidates, results, self._rows)
        if parent is not None:
            of_parent = f"{self._league.league}@{parent}"
            refs = tuple(dict.fromkeys((of_parent, *self.candidates)))
            payoffs = payoff_matrix(refs, results, {of_parent: self._inherited} | self._rows)
            self._priors = dict(zip(refs, payoffs[0].tolist(), strict=True))

    def drop_removed(self) -> None:
        """Drop candidates whose files were removed since the checkpoint. Others stay, whatever was published since."""
        league = self._league.league
        if self._storage is not None and self.candidates:
            with closing(Registry.open(self._storage)) as registry:
                present = {f"{league}@{number}" for number in registry.versions.numbers(league).get(league, ())}
            kept = [number for number, ref in enumerate(self.candidates) if ref in present]
            self.candidates = tuple(self.candidates[number] for number in kept)
            self._payoff = self._payoff[np.ix_(kept, kept)]

    def get_state(self) -> dict[str, Any]:
        """Return all that draws depend on."""
        return {
            "candidates": self.candidates,
            "scores": self._scores,
            "episodes": self._episodes,
            "all_episodes": self._all_episodes,
            "priors": self._priors,
            "inherited": self._inherited,
            "rows": self._rows,
            "unpublished": self._unpublished,
            "payoff": self._payoff,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore what `get_state` returned."""
        self.candidates, self._payoff = state["candidates"], state["payoff"]
        self._scores, self._priors = dict(state["scores"]), dict(state["priors"])
        self._inherited = dict(state["inherited"])
        self._episodes, self._all_episodes = dict(state["episodes"]), state["all_episodes"]
        self._rows, self._unpublished = dict(state["rows"]), dict(state["unpublished"])

    def _versions(self, registry: Registry) -> dict[str, str]:
        """Return the versions that may be candidates → their sources: exploiters, then the others, by age.

        Members play for a mixture, and a search version plays without its search.
        """
        assert self._settings is not None
        league = self._league.league
        numbers = registry.versions.numbers(league).get(league, [])
        compositions, exploiters = (
            registry.versions.compositions(league, numbers),
            registry.versions.exploiter_refs(league),
        )
        numbers = [number for number in numbers if number not in compositions]
        candidates = {number for number in numbers if f"{league}@{number}" not in exploiters}
        candidates = set(sorted(candidates)[-self._settings.window :])
        champions = {event.version for event in registry.aliases.history(league)}
        if self._settings.champions:
            for champion in champions:
                candidates |= set(compositions[champion].versions if champion in compositions else (champion,))
        if self._settings.exploiters:
            of_champions = registry.versions.exploiters(league, [f"{league}@{champion}" for champion in champions])
            newest = {exploiter.exploits: exploiter.number for exploiter in of_champions}
            candidates |= set(newest.values())
        rows = [registry.versions.get(league, number) for number in numbers if number in candidates]
        rows.sort(key=lambda row: (row.exploits is None, row.number))
        fixed = {opponent.ref for opponent in self._league.training.opponents.fixed}
        digest = self._interface.digest()
        return {
            row.ref: row.source for row in rows if row.manifest.interface.digest() == digest and row.ref not in fixed
        }
