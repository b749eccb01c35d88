"""Search versions: the network of a version looks ahead in the vectorised environment of its league.

The position is restored from the observation, so a search policy is stateless, like a graph. The network's value is
that of the agent that must act, and with the opposite sign that of the other one.
"""

import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from statistics import median

import numpy as np

from league.config.environment import EnvironmentConfig
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.errors import ArtifactCorrupt, GraphTimeout, InvalidInput, one_line
from league.interface import Interface
from league.policies import loading
from league.policies.draws import Generators, UniformNumbers
from league.policies.graph_runs import open_session, run_graph
from league.policies.onnx import DIST_INPUTS, RUN_TIMEOUT, VALUE
from league.policies.policy import Arrays, Policy
from league.refs import CheckpointRef, parse_ref
from league.registry.registry import Registry
from league.registry.storage.manifest import SearchRule
from league.registry.storage.rows import VersionRow
from league.search.gumbel import SequentialHalving
from league.search.puct import PUCT
from league.search.requirements import searchable
from league.search.rules import ILLEGAL, Estimates, Rule
from league.search.search import Search, SearchResult
from league.search.searched_actions import SearchedActions
from league.spaces import Discrete

NODES = 2**16
"""Nodes in memory at once, unless a single search has more."""
RULES: Mapping[SearchRule, Callable[[], Rule]] = {"puct": PUCT, "gumbel": SequentialHalving}

SIGNS = np.array([[1, -1], [-1, 1]], dtype=np.float32)
"""Of the value of each agent, if the first and if the second one acts."""


class SearchPolicy:
    """Plays the best action of a search, or samples from its improved policy. Without state.

    Args:
        make: Number of copies → environment; see `searchable`.
        graph: The ONNX graph with `action_dist_inputs` and `value`.
        action: The action space.
        rule: How the search selects actions.
        simulations: Of each search.
    """

    def __init__(
        self, make: Callable[[int], VectorEnv], graph: bytes, action: Discrete, rule: SearchRule, simulations: int
    ) -> None:
        try:
            self._session, self._action = open_session(graph), action
        except Exception as error:
            raise ArtifactCorrupt(f"ONNX Runtime cannot load the value graph: {one_line(error)}") from error
        self._observed = [node.name for node in self._session.get_inputs()]
        self._most_games = max(1, NODES // (simulations + 1))
        self._make = partial(
            Search, make, self._evaluate, RULES[rule](), simulations=simulations, num_actions=int(action.n)
        )
        self._search = self._make(games=1)

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,  # noqa: ARG002
        explore: bool = False,
        rng: Generators | UniformNumbers | None = None,
        deadline: float = math.inf,
        moves: int = 0,
    ) -> SearchedActions:
        """See Policy. `dist_inputs` are the logits of the improved policy.

        deadline, moves: See `Search.run`.

        Raises ObservationError for an observation that is not a position of the game.
        """
        result = self.search(observations, deadline, moves)
        fields = {name: getattr(result, name) for name in result.__slots__}
        return SearchedActions.of(fields, self._action, explore, rng)

    def search(self, observations: Arrays, deadline: float = math.inf, moves: int = 0) -> SearchResult:
        """Search from k positions.

        Args:
            observations: See Policy.
            deadline, moves: See `Search.run`.

        Raises:
            ObservationError: An observation is not a position of the game.
        """
        count = len(next(iter(observations.values())))
        if len(self._search.roots) < (games := min(count, self._most_games)):
            self._search = self._make(games=games)
        results = []
        for start in range(0, count, games):
            rows = {name: array[start : start + games] for name, array in observations.items()}
            roots = self._search.roots[: min(games, count - start)]
            results.append(self._search.run(self._search.env.restore(roots, rows), deadline=deadline, moves=moves))
        columns = [[getattr(result, name) for result in results] for name in SearchResult.__slots__]
        return SearchResult(*map(np.concatenate, columns))

    def seconds(self) -> float:
        """Return the time of a search from the initial position, the median of three."""
        root, times = self._search.roots[:1], []
        for _ in range(3):
            rows = self._search.env.reset(root, np.zeros(1, np.int64))
            began = time.perf_counter()
            self._search.run(rows)
            times.append(time.perf_counter() - began)
        return median(times)

    def _evaluate(self, rows: AgentRows) -> Estimates:
        feed = {name: rows.observations[name] for name in self._observed}
        try:
            logits, value = run_graph(self._session, [DIST_INPUTS, VALUE], feed, RUN_TIMEOUT)
        except GraphTimeout:
            raise
        except Exception as error:
            raise ArtifactCorrupt(f"ONNX Runtime cannot run the value graph: {one_line(error)}") from error
        logits = np.maximum(logits, ILLEGAL)  # a graph may mask by -inf
        # Faster than `any` and `clip` for a few rows.
        if np.count_nonzero(np.isnan(value)) or np.count_nonzero(np.isfinite(logits)) < logits.size:
            raise ArtifactCorrupt("the value graph returns NaN or infinity")
        value = np.minimum(np.maximum(value, -1), 1)
        return Estimates(logits, value[:, np.newaxis] * SIGNS.take(rows.agents, axis=0))


def contestant(
    ref: str, registry: Registry, interface: Interface, environment: EnvironmentConfig
) -> dict[str, tuple[str, Policy]]:
    """Load the policies of a contestant; see `league.policies.loading.contestant`. It may be a search version.

    environment: of the league. Raises also EnvironmentMismatch if it cannot be searched any more.
    """
    parsed = parse_ref(ref)
    version = registry.versions.resolve(parsed) if isinstance(parsed, CheckpointRef) else None
    if version is None or version.search is None:
        return loading.contestant(ref, registry, interface)
    base, search = registry.versions.get(version.league, version.search.version), version.search
    policies = search_policies(base, search.rule, search.simulations, registry, interface, environment)
    return {agent: (policy, policies[policy]) for agent, policy in interface.policies.items()}


def search_policies(
    base: VersionRow,
    rule: SearchRule,
    simulations: int,
    registry: Registry,
    interface: Interface,
    environment: EnvironmentConfig,
) -> dict[str, SearchPolicy]:
    """Load the policies of a version with a search, by id. See `publish_search`, also for the errors."""
    graphs, make, policies = value_graphs(base), searchable(environment, interface), {}
    for policy, file in graphs.items():
        action = interface.of_policy(policy).action
        assert isinstance(action, Discrete), "searchable requires it"
        graph = registry.artifacts.read(base.manifest, file)
        policies[policy] = SearchPolicy(make, graph, action, rule, simulations)
    return policies


def value_graphs(version: VersionRow) -> dict[str, str]:
    """Return policy id → file of the value graph. Raises InvalidInput if the version has none."""
    version.require_policies()
    files = {policy: manifest.value for policy, manifest in version.manifest.policies.items()}
    graphs = {policy: file for policy, file in files.items() if file is not None}
    if len(graphs) < len(files):
        raise InvalidInput(
            f"{version.ref} has no value graph, which a search needs. PPO, and what is derived from it, exports one"
            " with `critic: own` and without recurrence"
        )
    return graphs


def publish_search(
    registry: Registry,
    base: VersionRow,
    environment: EnvironmentConfig,
    interface: Interface,
    rule: SearchRule,
    simulations: int,
) -> VersionRow:
    """Publish a version that plays `base` with a search; see `VersionPublisher.publish_search`.

    environment, interface: of the league.

    Raises:
        InvalidInput: `base` has no value graph, is a mixture or itself a search version.
        EnvironmentMismatch: `base` was trained in another environment, or it cannot be searched; says why.
        LeagueError: What `publish_search` raises.
    """
    policies = search_policies(base, rule, simulations, registry, interface, environment)
    ms = 1000 * next(iter(policies.values())).seconds()
    return registry.publisher.publish_search(base.league, base.number, rule, simulations, ms)
