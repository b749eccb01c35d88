from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.vector import leduc_holdem
from league.environments.vector.equality import Comparison, DifferentialTest, compare
from league.environments.vector.leduc import deals, rules
from league.environments.vector.leduc.deals import Generators, deal, fast_deal
from league.environments.vector.leduc.rules import CALL, CHECK, FOLD, RAISE, Situation
from league.environments.vector.leduc_holdem import LeducHoldem, Start, tables
from league.environments.vector.vector_env import AgentRows, UnsupportedArguments
from league.spaces import ACTION_MASK, OBSERVATION

LEDUC = EnvironmentConfig(entry_point="pettingzoo.classic.leduc_holdem_v4")
JACK, QUEEN, KING = range(3)
ROUND_1 = ([CALL, CHECK], [CALL, RAISE, CALL], [CALL, RAISE, RAISE, CALL], [RAISE, CALL], [RAISE, RAISE, CALL])
FOLDS_1 = (
    [FOLD],
    [CALL, FOLD],
    [CALL, RAISE, FOLD],
    [CALL, RAISE, RAISE, FOLD],
    [RAISE, FOLD],
    [RAISE, RAISE, FOLD],
)
ROUND_2 = (
    [CHECK, CHECK],
    [CHECK, RAISE, CALL],
    [CHECK, RAISE, RAISE, CALL],
    [RAISE, CALL],
    [RAISE, RAISE, CALL],
    [FOLD],
    [CHECK, FOLD],
    [CHECK, RAISE, FOLD],
    [CHECK, RAISE, RAISE, FOLD],
    [RAISE, FOLD],
    [RAISE, RAISE, FOLD],
)
LINES = [*FOLDS_1, *(first + second for first in ROUND_1 for second in ROUND_2)]
"""All sequences of actions in a hand."""
MOST_CHIPS = [RAISE, RAISE, CALL, RAISE, RAISE, CALL]


def play(seed: int, actions: list[int]) -> AgentRows:
    """Play legal actions in one copy. Returns the last reports."""
    env, copy = LeducHoldem(1), np.array([0])
    (rows,) = env.reset(copy, np.array([seed]))
    for action in actions:
        assert rows.observations[ACTION_MASK][0, action], f"action {action} is illegal"
        (rows,) = env.step(copy, np.array([action]))
    return rows


def seed_of(small_blind: int, first: int, second: int, public: int) -> int:
    """Return a seed with this deal."""
    found = np.transpose(deal(np.arange(2000))) == (small_blind, first, second, public)
    return int(np.flatnonzero(found.all(axis=1))[0])


def test_all_lines_with_all_deals() -> None:
    cards = [cards for cards in product(range(3), repeat=3) if len(set(cards)) > 1]
    seeds = np.array([seed_of(small_blind, *each) for small_blind in (0, 1) for each in cards])
    copies = np.arange(len(seeds))
    test = DifferentialTest(LEDUC, LeducHoldem(len(seeds)))
    for actions in LINES:
        test.reset(copies, seeds)
        for action in actions:
            assert all(legal_actions(test, copy)[action] for copy in copies)
            test.step(copies, np.full(len(seeds), action))
        assert test.is_over.all()
    test.finish()


def legal_actions(test: DifferentialTest, copy: int) -> NDArray:
    ((_, mask),) = test.legal(copy)
    assert mask is not None
    return mask


IDLE, RESET, STEP = range(3)
INSTRUCTIONS = st.tuples(st.sampled_from([IDLE, RESET, STEP, STEP, STEP]), st.integers(0, 2**31 - 1))
"""What a copy does in a call. The number is the seed or chooses the action."""


@settings(max_examples=60)
@given(st.integers(1, 5), st.lists(st.lists(INSTRUCTIONS, min_size=5, max_size=5), max_size=12))
def test_any_sequence_of_calls(num_envs: int, calls: list[list[tuple[int, int]]]) -> None:
    test = DifferentialTest(LEDUC, LeducHoldem(num_envs))
    test.reset(np.arange(num_envs), np.arange(num_envs))
    for call in calls:
        numbers = np.array([number for _, number in call])
        kinds = np.array([kind for kind, _ in call[:num_envs]])
        starting = np.flatnonzero(kinds == RESET)
        test.reset(starting, numbers[starting])
        stepped = np.flatnonzero((kinds == STEP) & ~test.is_over)
        legal = [np.flatnonzero(legal_actions(test, copy)) for copy in stepped]
        actions = [of_copy[numbers[copy] % len(of_copy)] for copy, of_copy in zip(stepped, legal, strict=True)]
        test.step(stepped, np.array(actions))
    test.finish()


@pytest.mark.parametrize("small_blind", [0, 1])
def test_the_player_with_the_small_blind_starts(small_blind: int) -> None:
    rows = play(seed_of(small_blind, KING, QUEEN, JACK), [])
    assert rows.agents.tolist() == [small_blind]
    assert np.flatnonzero(rows.observations[OBSERVATION][0]).tolist() == [[KING, QUEEN][small_blind], 6 + 1, 21 + 2]


def test_each_round_allows_two_raises() -> None:
    seed = seed_of(0, KING, QUEEN, JACK)
    capped = [CALL, FOLD]
    for actions in (MOST_CHIPS[:2], MOST_CHIPS[:5]):
        rows = play(seed, actions)
        assert np.flatnonzero(rows.observations[ACTION_MASK][0]).tolist() == capped
    assert play(seed, MOST_CHIPS).rewards.tolist() == [7, -7]


@pytest.mark.parametrize(
    ("actions", "reward"), [([FOLD], -0.5), ([CALL, FOLD], 1), ([CALL, CHECK, RAISE, FOLD], 1), ([RAISE, FOLD], 1)]
)
def test_a_player_who_folds_loses_the_chips(actions: list[int], reward: float) -> None:
    rows = play(seed_of(0, JACK, KING, KING), actions)
    assert rows.rewards.tolist() == [reward, -reward]
    assert rows.agents.tolist() == [0, 1]
    assert not rows.observations[ACTION_MASK].any()


@pytest.mark.parametrize(
    ("cards", "reward"),
    [
        ((QUEEN, JACK, KING), 7),
        ((QUEEN, KING, JACK), -7),
        ((JACK, KING, JACK), 7),
        ((KING, JACK, JACK), -7),
        ((QUEEN, QUEEN, KING), 0),
    ],
)
def test_a_showdown(cards: tuple[int, int, int], reward: float) -> None:
    for small_blind in (0, 1):
        rows = play(seed_of(small_blind, *cards), MOST_CHIPS)
        assert rows.rewards.tolist() == [reward, -reward]
        assert not np.signbit(rows.rewards[rows.rewards == 0]).any()


def test_the_public_card_is_hidden_in_the_first_round() -> None:
    seed = seed_of(0, KING, QUEEN, JACK)
    for actions, public in (([CALL], []), ([RAISE, FOLD], []), ([CALL, CHECK], [JACK]), ([CALL, CHECK, FOLD], [JACK])):
        rows = play(seed, actions)
        for features in rows.observations[OBSERVATION]:
            assert np.flatnonzero(features[3:6]).tolist() == public


def test_a_hand_with_a_fast_seed_is_the_stock_hand_with_its_deal() -> None:
    copies, seeds = np.arange(100), 2**31 - 1 - np.arange(100)
    fast, stock = LeducHoldem(100), LeducHoldem(100)
    fast.use_fast_seeds()
    reports = [
        fast.reset(copies, seeds),
        stock.reset(copies, np.array([seed_of(*hand) for hand in zip(*fast_deal(seeds), strict=True)])),
    ]
    for actions in MOST_CHIPS:
        for (mine,), (theirs,) in [reports]:
            np.testing.assert_equal(asdict(mine), asdict(theirs))
        reports = [env.step(copies, np.full(100, actions)) for env in (fast, stock)]
    np.testing.assert_array_equal(reports[0][0].rewards, reports[1][0].rewards)


@pytest.mark.parametrize("name", ["num_players", "render_mode", "screen_height"])
def test_arguments_are_not_supported(name: str) -> None:
    with pytest.raises(UnsupportedArguments, match=name):
        LeducHoldem(1, **{name: 2})


def random_play(num_envs: int, steps: int) -> Comparison:
    return compare(LEDUC, leduc_holdem.LeducHoldem(num_envs), steps, seed=0)


def test_random_play() -> None:
    assert random_play(num_envs=16, steps=3000).difference is None


@pytest.mark.slow
def test_many_steps() -> None:
    comparison = random_play(num_envs=64, steps=200_000)
    assert comparison.difference is None
    assert comparison.steps >= 200_000


def in_tables(**change: Callable[[NDArray], NDArray]) -> tuple[Any, str, Any]:
    """A fault in some columns of the tables."""

    def faulty(start: Start) -> Any:
        correct = tables(start)
        return replace(correct, **{name: fault(getattr(correct, name)) for name, fault in change.items()})

    return leduc_holdem, "tables", faulty


class Reordered(Generators):
    """Takes outputs modulo the number of values, without rejections."""

    def integers(self, highest: int) -> NDArray[np.int64]:
        self._used += 1
        return (self._outputs[self._rows, self._used - 1] % (highest + 1)).astype(np.int64)


class Shared(LeducHoldem):
    """Returns the same array of masks at each call."""

    buffer = np.zeros((1000, 4), dtype=np.int8)

    def _rows(self, env_ids: NDArray[np.int64], situations: NDArray[np.int64]) -> Any:
        (rows,) = super()._rows(env_ids, situations)
        shared = self.buffer[: len(rows.envs)]
        shared[:] = rows.observations[ACTION_MASK]
        return (replace(rows, observations=rows.observations | {ACTION_MASK: shared}),)  # type: ignore[operator]


class Neighbours(LeducHoldem):
    """Moves all copies that are in the same situation as copy 0."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Any:
        before = self._situations.copy()
        rows = super().step(env_ids, actions)
        self._situations[before == before[0]] = self._situations[0]
        return rows


def winners_without_pairs(situation: Situation) -> tuple[int, ...]:
    if situation.winner is not None:
        return (situation.winner,)
    best = max(situation.cards[:2])
    return tuple(player for player in (0, 1) if situation.cards[player] == best)


correct_winners, correct_observation, correct_after = Situation._winners, Situation.observation, Situation.after

FAULTS: dict[str, tuple[Any, str, Any]] = {
    "raises of the same size in both rounds": (rules, "RAISES", (2, 2)),
    "one raise per round": (rules, "MAX_RAISES", 1),
    "blinds of one chip": (rules, "BIG_BLIND", 1),
    "pairs do not count": (Situation, "_winners", winners_without_pairs),
    "player 0 wins a tie": (Situation, "_winners", lambda situation: correct_winners(situation)[:1]),
    "the player who folds wins": (
        Situation,
        "_winners",
        lambda situation: correct_winners(situation) if situation.winner is None else (1 - situation.winner,),
    ),
    "the chips of the players are swapped": (
        Situation,
        "observation",
        lambda situation, player: correct_observation(situation, player)[[*range(6), *range(21, 36), *range(6, 21)]],
    ),
    "the public card is visible from the start": (
        Situation,
        "observation",
        lambda situation, player: correct_observation(replace(situation, round=1), player),
    ),
    "player 0 starts the second round": (
        Situation,
        "after",
        lambda situation, action: (
            replace(after, player=0)
            if (after := correct_after(situation, action)).round == 1 and situation.round == 0
            else after
        ),
    ),
    "the other player pays the small blind": in_tables(first=lambda first: first[::-1]),
    "the cards of the players are swapped": in_tables(first=lambda first: first.swapaxes(1, 2)),
    "a raise is a call": in_tables(following=lambda following: following[:, [0, 0, 2, 3]]),
    "last rows in reversed order": in_tables(
        rows=lambda rows: np.where(rows[:, 1:] >= 0, rows[:, ::-1], rows),
    ),
    "only one last row": in_tables(rows=lambda rows: rows[:, :1]),
    "rewards with the wrong sign": in_tables(rewards=lambda rewards: 0.0 - rewards),
    "rewards in chips": in_tables(rewards=lambda rewards: 2 * rewards),
    "negative zeros": in_tables(rewards=lambda rewards: np.where(rewards == 0, -0.0, rewards)),
    "rewards in float32": in_tables(rewards=lambda rewards: rewards.astype(np.float32)),
    "observations in float64": in_tables(observations=lambda observations: observations.astype(np.float64)),
    "masks in int64": in_tables(masks=lambda masks: masks.astype(np.int64)),
    "masks that allow all": in_tables(masks=np.ones_like),
    "masks after the end": in_tables(masks=lambda masks: np.where(masks.any(axis=1, keepdims=True), masks, 1)),
    "no terminations": in_tables(terminations=np.zeros_like),
    "draws without rejections": (deals, "Generators", Reordered),
    "an unshuffled deck": (deals, "RANKS", np.array([0, 1, 2, 0, 1, 2])),
    "an array that changes later": (leduc_holdem, "LeducHoldem", Shared),
    "a step that moves other copies": (leduc_holdem, "LeducHoldem", Neighbours),
}


@pytest.fixture
def uncached(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Environments enumerate their tables when they are created."""
    monkeypatch.setattr(leduc_holdem, "tables", tables.__wrapped__)
    return


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found(name: str, uncached: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*FAULTS[name])
    assert random_play(num_envs=16, steps=3000).difference is not None
