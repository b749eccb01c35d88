"""The differential test finds faults: mutants of the vectorised environments."""

import pytest

from league.config.environment import EnvironmentConfig
from league.environments.vector.equality import compare
from tests.support.environments.mutants import Mutation, mutated

VECTOR = "league.environments.vector."
ALTERNATION, BOARD_GAME = VECTOR + "alternation", VECTOR + "board_game"
CONNECT_FOUR, TICTACTOE, RPS = VECTOR + "connect_four", VECTOR + "tictactoe", VECTOR + "rps"
KUHN = "policy_league.examples.kuhn_poker_vector"

ENVIRONMENTS = {
    CONNECT_FOUR: ("pettingzoo.classic.connect_four_v3", "ConnectFour", (ALTERNATION, BOARD_GAME, CONNECT_FOUR)),
    TICTACTOE: ("pettingzoo.classic.tictactoe_v3", "TicTacToe", (ALTERNATION, BOARD_GAME, TICTACTOE)),
    RPS: ("pettingzoo.classic.rps_v2", "RockPaperScissors", (RPS,)),
    KUHN: ("policy_league.examples.kuhn_poker", "KuhnPokerVector", (ALTERNATION, KUHN)),
}

MOST_STEPS = 50_000
"""Enough for draws in connect four, which end one in 400 random games."""
MUTANTS = [
    # Connect four: lines, sentinels, masks and restarts.
    (CONNECT_FOUR, CONNECT_FOUR, "STRIDE = ROWS + 1", "STRIDE = ROWS"),
    (CONNECT_FOUR, CONNECT_FOUR, "[1, STRIDE - 1, STRIDE, STRIDE + 1]", "[1, STRIDE - 1, STRIDE, STRIDE + 2]"),
    (CONNECT_FOUR, CONNECT_FOUR, "[1, STRIDE - 1, STRIDE, STRIDE + 1]", "[1, STRIDE, STRIDE + 1]"),
    (CONNECT_FOUR, CONNECT_FOUR, "(2 * DIRECTIONS)", "DIRECTIONS"),
    (CONNECT_FOUR, CONNECT_FOUR, "height < ROWS - 1", "height < ROWS"),
    (CONNECT_FOUR, CONNECT_FOUR, "height < ROWS - 1", "height < ROWS - 2"),
    (CONNECT_FOUR, CONNECT_FOUR, "(ROWS - 1 - height) * COLUMNS", "height * COLUMNS"),
    (CONNECT_FOUR, CONNECT_FOUR, "self._boards[env_ids] = 0", "pass"),
    (CONNECT_FOUR, CONNECT_FOUR, "self._boards[env_ids] = 0", "self._boards[env_ids, 0] = 0"),
    (CONNECT_FOUR, CONNECT_FOUR, "self._heights[env_ids] = 0", "pass"),
    (CONNECT_FOUR, CONNECT_FOUR, " boards[players] = pieces", " boards[players ^ 1] = pieces"),
    (CONNECT_FOUR, CONNECT_FOUR, '("player_0", "player_1")', '("player_1", "player_2")'),
    # What all board games share.
    (CONNECT_FOUR, BOARD_GAME, "mover = moves & 1", "mover = (moves + 1) & 1"),
    (CONNECT_FOUR, BOARD_GAME, "planes[player ^ 1, 2 * cell + 1] = 1", "pass"),
    (CONNECT_FOUR, BOARD_GAME, "planes[player ^ 1, 2 * cell + 1] = 1", "planes[player, 2 * cell + 1] = 1"),
    (CONNECT_FOUR, BOARD_GAME, "self._planes[env_ids] = 0", "self._planes[env_ids, 0] = 0"),
    (CONNECT_FOUR, BOARD_GAME, "self._moves[env_ids] = 0", "pass"),
    (CONNECT_FOUR, BOARD_GAME, "self._masks[env_ids] = 1", "pass"),
    (CONNECT_FOUR, BOARD_GAME, "(moves == self._cells - 1)", "(moves == self._cells)"),
    (CONNECT_FOUR, BOARD_GAME, "2 * rows.envs + rows.agents, axis=0", "2 * rows.envs, axis=0"),
    (TICTACTOE, BOARD_GAME, "self._masks.take(rows.envs, axis=0)", "self._masks[: len(rows.envs)]"),
    (TICTACTOE, BOARD_GAME, "num_actions), dtype=np.int8)", "num_actions), dtype=np.uint8)"),
    # Rows of the two players.
    (
        CONNECT_FOUR,
        ALTERNATION,
        "rewards[second - 1] = 0.0 - gains[ended]",
        "rewards[second - 1] = -1.0 * gains[ended]",
    ),
    (CONNECT_FOUR, ALTERNATION, "rewards[second] = gains[ended]", "rewards[second] = 0.0 - gains[ended]"),
    (TICTACTOE, ALTERNATION, "terminations[second] = terminations[second - 1]", "terminations[second]"),
    (TICTACTOE, ALTERNATION, "agents[second] ^= 1", "agents[second - 1] ^= 1"),
    (TICTACTOE, ALTERNATION, "ended + np.arange(1, len(ended) + 1)", "ended + np.arange(len(ended))"),
    # Tic-tac-toe.
    (TICTACTOE, TICTACTOE, "(2, 4, 6))", "(2, 4, 5))"),
    (TICTACTOE, TICTACTOE, "(6, 7, 8), ", ""),
    (TICTACTOE, TICTACTOE, "(1 << actions)", "(1 << (actions % 8))"),
    (TICTACTOE, TICTACTOE, "self._boards[env_ids] = 0", "self._boards[env_ids, 0] = 0"),
    (TICTACTOE, TICTACTOE, "self._masks.reshape(-1)[env_ids * 9 + actions] = 0", "pass"),
    # Rock paper scissors.
    (RPS, RPS, "% 2 == 1", "% 2 == 0"),
    (RPS, RPS, "pairs == opponents, 0.0", "pairs == opponents, -0.0"),
    (RPS, RPS, "pairs > opponents", "pairs < opponents"),
    (RPS, RPS, "cycles >= self._max_cycles", "cycles > self._max_cycles"),
    (RPS, RPS, "self._cycles[env_ids] = 0", "pass"),
    (RPS, RPS, "opponents.ravel()", "pairs.ravel()"),
    (RPS, RPS, "opponents.ravel()", "opponents.ravel().astype(np.int32)"),
    (RPS, RPS, "pairs = actions.reshape(-1, 2).astype(np.int64)", "pairs = actions.reshape(-1, 2)[:, ::-1]"),
    (RPS, RPS, "np.full(rows, self._num_actions)", "np.full(rows, self._num_actions - 1)"),
    (RPS, RPS, "np.tile(np.arange(2), len(env_ids))", "np.repeat(np.arange(2), len(env_ids))"),
    # Kuhn poker.
    (KUHN, KUHN, "stake = 1 + actions", "stake = 2 - actions"),
    (KUHN, KUHN, "np.where(folded, -1,", "np.where(folded, 1,"),
    (KUHN, KUHN, "(player == 0)", "(player == 1)"),
    (KUHN, KUHN, "self._last_action[env_ids] = NO_ACTION", "pass"),
    (KUHN, KUHN, "self._observations[env_ids] = 0", "pass"),
    (KUHN, KUHN, "FIRST_BET + 2 * moves + actions", "FIRST_BET + 2 * moves"),
    (KUHN, KUHN, "self._observations[env_ids, :, FIRST_BET", "self._observations[env_ids, 0, FIRST_BET"),
    (KUHN, KUHN, "must_act = ~rows.terminations", "must_act = rows.terminations | True"),
    (KUHN, KUHN, "seeds, 1)", "seeds + 1, 1)"),
    (KUHN, KUHN, "seeds, 1)[0], 0, 1)", "seeds, 1)[0], 0, 0.5)"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("environment", "module", "old", "new"), MUTANTS)
def test_each_fault_is_found(environment: str, module: str, old: str, new: str) -> None:
    entry_point, name, modules = ENVIRONMENTS[environment]
    with mutated(Mutation(module, old, new), modules) as mutant:
        vector = getattr(mutant, name)(4)
        assert compare(EnvironmentConfig(entry_point=entry_point), vector, MOST_STEPS, seed=0).difference is not None


@pytest.mark.slow
@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_without_a_fault_nothing_is_found(environment: str) -> None:
    entry_point, name, modules = ENVIRONMENTS[environment]
    with mutated(Mutation("", "", ""), modules) as same:
        vector = getattr(same, name)(4)
        assert compare(EnvironmentConfig(entry_point=entry_point), vector, 5000, seed=0).difference is None
