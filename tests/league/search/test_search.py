"""Games are searched without knowledge: all actions are equally likely, and all positions worth 0."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from itertools import product
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.environments.vector.connect_four import ConnectFour
from league.environments.vector.tictactoe import TicTacToe
from league.environments.vector.vector_env import AgentRows, VectorEnv
from league.policies.line_games.game import TIC_TAC_TOE
from league.policies.line_games.solver import LineGameSolver
from league.search.gumbel import SequentialHalving
from league.search.puct import PUCT
from league.search.rules import SHARE, Estimates, Nodes, Rule
from league.search.search import FEW_GAMES, LEAVES, Search, SearchResult
from league.spaces import ACTION_MASK, OBSERVATION

RULES: dict[str, Callable[[], Rule]] = {"PUCT": PUCT, "sequential halving": SequentialHalving}
MOVES = 6
ACTIONS = {TicTacToe: 9, ConnectFour: 7}


def uniform(rows: AgentRows) -> Estimates:
    mask = rows.observations[ACTION_MASK]
    return Estimates(np.zeros(mask.shape, np.float32), np.zeros((len(mask), 2), np.float32))


def hashed(rows: AgentRows) -> Estimates:
    """Arbitrary numbers that depend on the position only."""
    boards = rows.observations[OBSERVATION].reshape(len(rows.envs), -1)
    weights = np.random.default_rng(0).normal(size=(boards.shape[1], ACTIONS[ConnectFour] + 1)).astype(np.float32)
    numbers = np.sin((boards[:, :, np.newaxis] * weights).sum(axis=1) * 3)
    values = np.stack([numbers[:, -1], -numbers[:, -1]], axis=1)
    values[rows.agents == 1] *= -1
    return Estimates(2 * numbers[:, :-1], values)


def searched(
    game: type[TicTacToe] | type[ConnectFour],
    games: Sequence[Sequence[int]],
    rule: Rule,
    simulations: int,
    evaluate: Callable[[AgentRows], Estimates] = uniform,
    seed: int | None = None,
    leaves: int = LEAVES,
    few_games: int = FEW_GAMES,
) -> SearchResult:
    """Search from the positions after some games."""
    search = Search(
        game,
        evaluate,
        rule,
        games=len(games),
        simulations=simulations,
        num_actions=ACTIONS[game],
        leaves=leaves,
        few_games=few_games,
    )
    rows = [positions(search.env, search.roots, games)]
    rng = None if seed is None else [np.random.default_rng([seed, *actions]) for actions in games]
    return search.run(rows, rng, moves=MOVES)


games_of_connect_four = st.lists(st.lists(st.integers(0, 6), max_size=6), min_size=1, max_size=5)


@settings(max_examples=15, deadline=None)
@given(games_of_connect_four, st.integers(1, 40), st.sampled_from(sorted(RULES)), st.booleans())
def test_all_simulations_visit_legal_actions(
    games: list[list[int]], simulations: int, rule_name: str, has_noise: bool
) -> None:
    games.append([0, 0, 0, 0, 0, 0])  # a full column
    result = searched(ConnectFour, games, RULES[rule_name](), simulations, hashed, 3 if has_noise else None)
    assert (result.visits.sum(axis=1) == simulations).all()
    assert result.visits[-1, 0] == 0
    assert result.actions[-1] != 0
    assert (result.logits[-1, 0] < result.logits[-1, result.actions[-1]]).all()
    assert (np.abs(result.values) <= 1).all()


@settings(max_examples=15, deadline=None)
@given(games_of_connect_four, st.integers(1, 40), st.sampled_from(sorted(RULES)), st.randoms())
def test_the_result_of_a_game_depends_neither_on_the_others_nor_on_their_order(
    games: list[list[int]], simulations: int, rule_name: str, random: Random
) -> None:
    order = list(range(len(games)))
    random.shuffle(order)
    together, shuffled, alone = (
        searched(ConnectFour, positions, RULES[rule_name](), simulations, hashed, seed=5, few_games=0)
        for positions in (games, [games[i] for i in order], games[:1])
    )
    assert (shuffled.visits == together.visits[order]).all()
    assert (shuffled.actions == together.actions[order]).all()
    assert (shuffled.values == together.values[order]).all()
    assert (alone.visits == together.visits[:1]).all()
    assert (alone.logits == together.logits[:1]).all()


@settings(max_examples=30, deadline=None)
@given(
    games_of_connect_four,
    st.integers(1, 150),
    st.sampled_from(sorted(RULES)),
    st.booleans(),
    st.integers(1, 12),
    st.sampled_from([uniform, hashed]),
)
def test_trees_of_objects_and_in_arrays_are_equal(
    games: list[list[int]],
    simulations: int,
    rule_name: str,
    has_noise: bool,
    leaves: int,
    evaluate: Callable[[AgentRows], Estimates],
) -> None:
    objects, arrays = (
        searched(
            ConnectFour,
            games,
            RULES[rule_name](),
            simulations,
            evaluate,
            3 if has_noise else None,
            leaves,
            few_games=few_games,
        )
        for few_games in (len(games), 0)
    )
    assert (objects.actions == arrays.actions).all()
    assert (objects.visits == arrays.visits).all()
    assert (objects.lines == arrays.lines).all()
    np.testing.assert_allclose(objects.values, arrays.values, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(objects.logits, arrays.logits, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_tictactoe_is_never_lost_against_the_solver() -> None:
    """The opponent tries every move that keeps the best outcome, from both sides."""
    solver = LineGameSolver(TIC_TAC_TOE)
    games: list[tuple[int, ...]] = [(), *((first,) for first in range(9))]
    while games:
        result = searched(TicTacToe, games, PUCT(), 3000)
        following = []
        for moved in ((*game, action) for game, action in zip(games, result.actions.tolist(), strict=True)):
            rows = played(TicTacToe, moved)
            if rows.has_ended.any():
                continue
            outcomes = solver.outcomes(*solver.position(rows.observations[OBSERVATION][0]))
            assert max(outcomes.values()) <= 0, f"{moved} loses"
            answers = [(*moved, answer) for answer, outcome in outcomes.items() if outcome == max(outcomes.values())]
            following += [answer for answer in answers if not played(TicTacToe, answer).has_ended.any()]
        games = following


class PlainNode:
    """A position of connect four, one Python object each."""

    def __init__(self, actions: tuple[int, ...]) -> None:
        rows = played(ConnectFour, actions)
        self.actions, self.player = actions, len(actions) % 2
        self.children: dict[int, PlainNode] = {}
        self.is_over = bool(rows.has_ended.any())
        if self.is_over:
            self.values = dict(zip(rows.agents.tolist(), rows.rewards.tolist(), strict=True))
            return
        logits, values = hashed(rows)
        self.values = dict(enumerate(values[0].tolist()))
        self.legal = np.flatnonzero(rows.observations[ACTION_MASK][0]).tolist()
        shares = np.exp(logits[0][self.legal].astype(float))
        self.priors = dict(zip(self.legal, (shares / shares.sum()).tolist(), strict=True))
        self.returns: dict[int, list[float]] = {action: [] for action in self.legal}

    def path(self, action: int, next_action: "NextAction", sent: Counter[tuple["PlainNode", int]]) -> "Path":
        """Send a simulation from here, which is not evaluated yet."""
        node, path = self, list[tuple[PlainNode, int]]()
        while True:
            path.append((node, action))
            sent[node, action] += 1
            if action not in node.children or node.children[action].is_over:
                return path
            node = node.children[action]
            action = next_action(node, sent)

    def puct(self, sent: Counter[tuple["PlainNode", int]]) -> int:
        mean = (self.values[self.player] + sum(map(sum, self.returns.values()))) / (1 + self.count())

        def score(action: int) -> float:
            lost, visits = sent[self, action], len(self.returns[action])
            total = sum(self.returns[action]) if visits else mean
            exploration = 1.5 * self.priors[action] * math.sqrt(1 + self.count()) / (1 + visits + lost)
            return (total - lost) / (max(visits, 1) + lost) + exploration

        return max(self.legal, key=score)

    def count(self) -> int:
        return sum(map(len, self.returns.values()))

    def improved(self) -> dict[int, float]:
        """Logits + σ(completed q)."""
        visited = [action for action in self.legal if self.returns[action]]
        mean = {action: sum(self.returns[action]) / len(self.returns[action]) for action in visited}
        mixed = self.values[self.player]
        if visited:
            weights = sum(self.priors[action] for action in visited)
            average = sum(self.priors[action] * mean[action] for action in visited) / weights
            mixed = (mixed + self.count() * average) / (1 + self.count())
        scale = 50 + max(map(len, self.returns.values()))
        return {
            action: math.log(self.priors[action]) + scale * (1 + mean.get(action, mixed)) / 2 for action in self.legal
        }

    def next_action(self, sent: Counter[tuple["PlainNode", int]]) -> int:
        improved = self.improved()
        highest = max(improved.values())
        total = sum(math.exp(logit - highest) for logit in improved.values())
        return max(
            self.legal,
            key=lambda action: (
                math.exp(improved[action] - highest) / total
                - (len(self.returns[action]) + sent[self, action]) / (1 + self.count())
            ),
        )


Path = list[tuple[PlainNode, int]]
NextAction = Callable[[PlainNode, Counter[tuple[PlainNode, int]]], int]


def evaluate_all(paths: Sequence[Path]) -> None:
    """Evaluate the ends of the paths of a round, and tell their nodes."""
    for path in paths:
        node, action = path[-1]
        if action not in node.children:
            node.children[action] = PlainNode((*node.actions, action))
    for path in paths:
        values = path[-1][0].children[path[-1][1]].values
        for node, action in path:
            node.returns[action].append(values[node.player])


def plain_search(
    game: tuple[int, ...], simulations: int, gumbel: NDArray[np.float64], leaves: int
) -> tuple[list[int], int]:
    """Sequential halving, phase by phase."""
    root = PlainNode(game)

    def score(action: int) -> float:
        return float(gumbel[action]) + root.improved()[action]

    remaining = sorted(root.legal, key=score, reverse=True)
    phases = math.ceil(math.log2(len(remaining)))
    while root.count() < simulations:
        end = len(root.returns[remaining[0]]) + max(1, simulations // (phases * len(remaining)))
        while (visits := len(root.returns[remaining[0]])) < end and (left := simulations - root.count()):
            # All of them equally often, the best ones first, in case that the simulations do not suffice.
            times = min(visits // SHARE, leaves // len(remaining), left // len(remaining), end - visits)
            waiting = list(remaining)
            while waiting and (left := simulations - root.count()):
                best = sorted(waiting, key=score, reverse=True)[: min(leaves, left)]
                waiting = [action for action in waiting if action not in best]
                sent = Counter[tuple[PlainNode, int]]()
                numbered = product(range(max(1, times)), best)
                evaluate_all([root.path(action, PlainNode.next_action, sent) for _, action in numbered])
        remaining = sorted(remaining, key=score, reverse=True)[: max(2, len(remaining) // 2)]
    visits = [len(root.returns.get(action, ())) for action in range(7)]
    most = [action for action in root.legal if visits[action] == max(visits)]
    return visits, max(most, key=score)


@pytest.mark.parametrize("game", [(), (3, 2, 3), (0, 0, 0, 0, 0, 0), (0, 1, 0, 1, 0, 1)])
@pytest.mark.parametrize(("simulations", "leaves"), [(60, 1), (60, 5), (200, LEAVES)])
def test_puct_equals_a_plain_search(game: tuple[int, ...], simulations: int, leaves: int) -> None:
    """The plain search walks from the root once for each simulation, and counts those of its round as losses."""
    root = PlainNode(game)
    sizes = PUCT().start(Nodes(*np.zeros((6, 1, 7), dtype=np.float32)), simulations, leaves, None)[0].tolist()
    for size in sizes:
        sent = Counter[tuple[PlainNode, int]]()
        evaluate_all([root.path(root.puct(sent), PlainNode.puct, sent) for _ in range(size)])
    result = searched(ConnectFour, [game], PUCT(), simulations, hashed, leaves=leaves)
    assert result.visits[0].tolist() == [len(root.returns.get(action, ())) for action in range(7)]
    assert max(sizes) == min(leaves, simulations // SHARE)


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_tactics_are_found_and_values_of_finished_games_are_exact(rule: Callable[[], Rule]) -> None:
    for game, moves, simulations, answers in (
        (TicTacToe, (0, 3, 1, 4), 50, [2]),  # wins
        (TicTacToe, (0, 3, 1, 4, 8), 50, [5]),
        (TicTacToe, (0, 1, 3, 6), 400, [4]),  # a fork
        (ConnectFour, (0, 6, 0, 6, 0), 200, [0]),
        (ConnectFour, (3, 0, 3, 1, 3), 200, [3]),  # parries a threat
        (ConnectFour, (2, 2, 3, 3), 1000, [1, 4]),  # three in the bottom row with both ends open
    ):
        assert searched(game, [moves], rule(), simulations).actions[0] in answers
    # The only legal move wins, or draws. The position itself was evaluated as 0.
    result = searched(TicTacToe, [(0, 1, 2, 4, 5, 3, 7, 6), (0, 1, 2, 4, 7, 3, 5, 8)], rule(), 49)
    assert result.actions.tolist() == [8, 6]
    assert result.values.tolist() == [np.float32(49 / 50), 0]


@cache
def played(game: type[TicTacToe] | type[ConnectFour], actions: tuple[int, ...]) -> AgentRows:
    return positions(game(1), np.array([0]), [actions], is_open=False)


def positions(
    env: VectorEnv, copies: NDArray[np.int64], games: Sequence[Sequence[int]], is_open: bool = True
) -> AgentRows:
    rows = env.reset(copies, np.zeros(len(copies), dtype=np.int64))[0]
    for copy, actions in zip(copies, games, strict=True):
        for action in actions:
            (row,) = env.step(np.array([copy]), np.array([action]))
            if not is_open:
                rows = row
                continue
            assert not row.has_ended.any(), "a position in which a player must move"
            place = rows.envs == copy
            for name, observation in row.observations.items():
                rows.observations[name][place] = observation
            rows.agents[place] = row.agents
    return rows


@pytest.mark.parametrize("rule", RULES.values(), ids=RULES)
def test_a_search_can_be_repeated_and_its_nodes_reused(rule: Callable[[], Rule]) -> None:
    search = Search(ConnectFour, hashed, rule(), games=2, simulations=60, num_actions=7)
    first = search.run([positions(search.env, search.roots, [(3, 3), (0,)])])
    other = search.run([positions(search.env, search.roots[:1], [(6, 5, 4)])])
    again = search.run([positions(search.env, search.roots, [(3, 3), (0,)])])
    assert (first.visits == again.visits).all()
    assert (first.values == again.values).all()
    assert (other.visits == searched(ConnectFour, [(6, 5, 4)], rule(), 60, hashed).visits).all()


def test_sequential_halving_equals_a_plain_search(subtests: pytest.Subtests) -> None:
    for noise, (game, simulations), leaves in product(
        (False, True), (((3, 2), 12), ((3, 2), 32), ((3, 2), 100), ((0,) * 6, 41)), (1, LEAVES)
    ):
        with subtests.test(noise=noise, simulations=simulations, leaves=leaves):
            result = searched(
                ConnectFour, [game], SequentialHalving(), simulations, hashed, 1 if noise else None, leaves
            )
            gumbel = np.random.default_rng([1, *game]).gumbel(size=7) if noise else np.zeros(7)
            visits, action = plain_search(game, simulations, gumbel, leaves)
            assert result.visits[0].tolist() == visits
            assert result.actions[0] == action
