"""Does a version of connect four keep the outcome that perfect play reaches?

Late positions, solved exactly.

The positions come from games that `script:one_ply` plays against itself: at most one of each game, with 24 pieces or
more, in which some legal moves reach the best outcome and others do not. They are the same in each run. The bound is
the lower limit of Wilson's two-sided 95 % interval. Scripts on the same positions are printed for comparison.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from pettingzoo.classic import connect_four_v3
from scipy.stats import binomtest

from benchmarks.harness import Quick, Target
from league.policies.line_games.game import CONNECT_FOUR
from league.policies.line_games.solver import MAX_EMPTY, LineGameSolver
from league.policies.loading import contestant, pinned
from league.policies.policy import Policy
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.spaces import ACTION_MASK, OBSERVATION

POSITIONS = 500
KEPT = 97.0
EARLIEST = CONNECT_FOUR.rows * CONNECT_FOUR.columns - MAX_EMPTY
"""Pieces on the board."""
SCRIPTS = ("script:random", "script:one_ply", "script:minimax_4", "script:mcts_1000")
SEED = 0


@dataclass(frozen=True, slots=True)
class DecisivePositions:
    """Boards (k, 6, 7, 2) int8, legal actions (k, 7) int8, and the actions that keep the best outcome (k, 7) bool."""

    boards: NDArray[np.int8]
    masks: NDArray[np.int8]
    keeping: NDArray[np.bool_]

    def kept(self, policy: Policy) -> NDArray[np.bool_]:
        """Return in which positions the greedy action of a policy keeps the outcome, (k,)."""
        generators = [np.random.default_rng([SEED, row]) for row in range(len(self.boards))]
        actions = policy.act({OBSERVATION: self.boards, ACTION_MASK: self.masks}, rng=generators).actions
        return self.keeping[np.arange(len(actions)), actions]


def decisive_positions(number: int, player: Policy) -> DecisivePositions:
    """Return the first `number` positions. player: moves for both sides."""
    solver, generator = LineGameSolver(CONNECT_FOUR), np.random.default_rng(SEED)
    positions: list[tuple[NDArray, NDArray, NDArray]] = []
    while len(positions) < number:
        late = _late_positions(player, generator)
        for at in generator.permutation(len(late)):
            board, mask = late[at]
            keeping = _keeping(solver, board)
            if keeping.sum() < mask.sum():
                positions.append((board, mask, keeping))
                break
    return DecisivePositions(*(np.stack(column) for column in zip(*positions, strict=True)))


def _late_positions(player: Policy, generator: np.random.Generator) -> list[tuple[NDArray, NDArray]]:
    """Play a game; return its boards and legal actions with at least EARLIEST pieces."""
    env, positions = connect_four_v3.env(), []
    env.reset()
    for _ in env.agent_iter():
        observation, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            break
        board, mask = observation["observation"].astype(np.int8), observation["action_mask"].astype(np.int8)
        if board.sum() >= EARLIEST:
            positions.append((board, mask))
        batch = {OBSERVATION: board[np.newaxis], ACTION_MASK: mask[np.newaxis]}
        env.step(int(player.act(batch, rng=[generator]).actions[0]))
    env.close()
    return positions


def _keeping(solver: LineGameSolver, board: NDArray) -> NDArray[np.bool_]:
    """Return which actions reach the best outcome, (7,)."""
    outcomes = solver.outcomes(*solver.position(board))
    best = max(outcomes.values())
    return np.array([outcomes.get(action) == best for action in range(CONNECT_FOUR.actions)])


def main(ref: Annotated[str, typer.Argument()] = "connect_four@champion", quick: Quick = False) -> Iterator[Target]:
    """The shares of the scripts and of the version."""
    number = POSITIONS // 10 if quick else POSITIONS
    registry = Registry.open()
    league = CheckpointRef.parse(ref).league
    interface, version = registry.leagues.get(league).interface, pinned(ref, league, registry)

    def policy(name: str) -> Policy:
        return next(iter(contestant(name, registry, interface).values()))[1]

    positions = decisive_positions(number, policy("script:one_ply"))
    keeping, legal = positions.keeping.sum(axis=1).mean(), positions.masks.sum(axis=1).mean()
    print(f"{number} positions; on average {keeping:.2f} of {legal:.2f} legal moves keep the outcome")
    for name in (*SCRIPTS, version):
        kept = positions.kept(policy(name))
        low = binomtest(int(kept.sum()), number).proportion_ci(0.95, "wilson").low
        least = KEPT if name == version else None
        yield Target(name, round(100 * kept.mean(), 1), "%", at_least=least, note=f"lower bound {low:.2%}")
