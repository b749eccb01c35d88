import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from evaluation.statistics.payoff import score_interval, tabulate
from evaluation.statistics.population import resampled_interval, resampled_scores
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.sums import tally
from tests.support.closeness import close
from tests.support.examples import examples
from tests.support.leagues.payoff_matches import match

SIDES = ("first", "second")


def test_scores_games_and_sides() -> None:
    payoff = tabulate(
        ("a", "b", "c"),
        SIDES,
        tally([match(("a", "b"), (1.0, 0.5)), match(("b", "a"), (1.0, 0.0)), match(("c", "b"), (1, 1))]),
    )
    assert payoff.contestants == ("a", "b", "c")
    assert close(payoff.score, ((None, 0.625, None), (0.375, None, 0.0), (None, 1.0, None)))
    assert payoff.games == ((0, 4, 0), (4, 0, 2), (0, 2, 0))
    assert close(payoff.by_side["first"], ((None, 1.0, None), (0.75, None, 0.0), (None, 1.0, None)))
    assert close(payoff.by_side["second"], ((None, 0.25, None), (0.0, None, 0.0), (None, 1.0, None)))


def test_without_matches_the_table_is_empty() -> None:
    assert tabulate(("a",), SIDES, {}).score == ((None,),)


ROCK_PAPER_SCISSORS = np.array([[0.5, 0.0, 1.0], [1.0, 0.5, 0.0], [0.0, 1.0, 0.5]])
TRANSITIVE = np.array([[0.0, -1.0, -1.0], [1.0, 0.0, -1.0], [1.0, 1.0, 0.0]])


@st.composite
def games(draw: st.DrawFn) -> np.ndarray:
    """Antisymmetric payoffs within [-1, 1], including ties and copies."""
    size = draw(st.integers(1, 7))
    upper = draw(arrays(np.float64, (size, size), elements=st.integers(-4, 4).map(lambda n: n / 4)))
    return np.triu(upper, 1) - np.triu(upper, 1).T


def test_values_equal_those_of_open_spiel_and_nash_averaging() -> None:
    assert alpha_rank(ROCK_PAPER_SCISSORS) == pytest.approx([1 / 3] * 3, abs=1e-4)
    share, value = nash_averaging(2 * ROCK_PAPER_SCISSORS - 1)
    assert (share, value) == (pytest.approx([1 / 3] * 3, abs=1e-4), pytest.approx([0, 0, 0], abs=1e-4))
    share, value = nash_averaging(TRANSITIVE)
    assert (share, value) == (pytest.approx([0, 0, 1], abs=1e-4), pytest.approx([-1, -1, 0], abs=1e-4))
    assert alpha_rank((TRANSITIVE + 1) / 2) == pytest.approx([0, 0, 1], abs=1e-4)


@examples(200)
@given(games())
def test_no_strategy_gains_against_the_equilibrium(payoff: np.ndarray) -> None:
    share, value = nash_averaging(payoff)
    assert (share >= 0).all()
    assert share.sum() == pytest.approx(1)
    assert value.max() <= 1e-6
    assert value[share > 1e-6] == pytest.approx(0, abs=1e-5)


@examples(100)
@given(games(), st.data())
def test_copies_divide_the_share_of_the_original(payoff: np.ndarray, data: st.DataObject) -> None:
    """Nash averaging is invariant to redundancy: copies divide a share, and the other shares do not change."""
    size = len(payoff)
    copied = data.draw(st.integers(0, size - 1))
    index = [*range(size), copied]
    share, value = nash_averaging(payoff)
    with_copy, value_with_copy = nash_averaging(payoff[np.ix_(index, index)])
    assert with_copy[copied] == pytest.approx(with_copy[size], abs=1e-4)
    assert value_with_copy[:size] == pytest.approx(value, abs=1e-4) or _is_not_unique(payoff)
    if not _is_not_unique(payoff):
        merged = with_copy[:size].copy()
        merged[copied] += with_copy[size]
        assert merged == pytest.approx(share, abs=1e-4)


def _is_not_unique(payoff: np.ndarray) -> bool:
    """With several equilibria, the one of maximum entropy depends on the number of copies."""
    share, _ = nash_averaging(payoff)
    inside = payoff[np.ix_(share > 1e-6, share > 1e-6)]
    return np.linalg.matrix_rank(inside, tol=1e-6) < len(inside) - 1


def test_of_several_equilibria_the_one_of_maximum_entropy_is_chosen() -> None:
    assert nash_averaging(np.zeros((4, 4)))[0] == pytest.approx([0.25] * 4)
    share, _ = nash_averaging(np.kron(np.eye(2), TRANSITIVE[:2, :2]) * 0)
    assert share == pytest.approx([0.25] * 4)


@examples(100)
@given(games())
def test_alpha_rank_is_stationary_and_favours_undefeated_strategies(payoff: np.ndarray) -> None:
    rank = alpha_rank((payoff + 1) / 2)
    assert (rank >= 0).all()
    assert rank.sum() == pytest.approx(1)
    for one in range(len(payoff)):
        others = np.delete(payoff[one], one)
        if len(others) and (others >= 0.25).all():
            assert rank[one] == pytest.approx(1, abs=1e-3)


def test_alpha_rank_agrees_with_the_eigenvector() -> None:
    """With weak selection, where standard linear algebra is accurate enough."""
    rng, size, population, selection = np.random.default_rng(0), 6, 10, 3.0
    upper = np.triu(rng.uniform(-0.5, 0.5, (size, size)), 1)
    scores = 0.5 + upper - upper.T
    chain = np.zeros((size, size))
    for resident in range(size):
        for mutant in range(size):
            if resident != mutant:
                u = selection * population / (population - 1) * (scores[mutant, resident] - 0.5)
                chain[resident, mutant] = (1 - np.exp(-u)) / (1 - np.exp(-population * u)) / (size - 1)
    chain += np.diag(1 - chain.sum(axis=1))
    values, vectors = np.linalg.eig(chain.T)
    expected = np.real(vectors[:, np.argmax(np.real(values))])
    assert alpha_rank(scores, selection, population) == pytest.approx(expected / expected.sum(), rel=1e-6)


def test_several_tables_are_ranked_at_once() -> None:
    tables = np.stack([ROCK_PAPER_SCISSORS, (TRANSITIVE + 1) / 2])
    assert alpha_rank(tables) == pytest.approx(np.stack([alpha_rank(table) for table in tables]))


def test_intervals_with_little_evidence_are_wide() -> None:
    names = ("rock", "paper", "scissors")
    few = [match((names[i], names[(i + 1) % 3]), points) for i in range(3) for points in ((0, 0), (0, 1)) * 2]
    many = few * 50
    spread = []
    for matches in (few, many):
        tables = resampled_scores(names, tally(matches), resamples=100)
        assert tables[0] == pytest.approx(0.5 + 0.25 * np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]))
        low, high = resampled_interval(np.stack([nash_averaging(2 * table - 1)[0] for table in tables]))
        spread.append((high - low).max())
    assert spread[1] < spread[0] / 3


def test_an_incomplete_table_is_rejected() -> None:
    with pytest.raises(ValueError, match="a and c never met"):
        resampled_scores(("a", "b", "c"), tally([match(("a", "b"), (1, 0)), match(("b", "c"), (1, 0))]))


@pytest.mark.parametrize("scores", [[0.5], [[0.5, 1.0], [0.5, 0.5]], np.zeros((2, 3))])
def test_invalid_tables_are_rejected(scores: object) -> None:
    with pytest.raises(ValueError, match="scores"):
        alpha_rank(scores)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="antisymmetric"):
        nash_averaging(scores)  # type: ignore[arg-type]


def test_the_interval_of_equal_scores_has_a_width() -> None:
    """Wilson's interval of ten wins in ten games is [0.722, 1]."""
    assert score_interval([1.0] * 10) == pytest.approx((1.0, 0.72247, 1.0), abs=1e-5)


@given(st.lists(st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]), min_size=1), st.floats(0.5, 0.999))
def test_the_interval_of_a_score_contains_it(scores: list[float], confidence: float) -> None:
    mean, low, high = score_interval(scores, confidence)
    assert 0 <= low <= mean + 1e-12
    assert mean - 1e-12 <= high <= 1
    _, other_low, other_high = score_interval([1 - score for score in scores], confidence)
    assert (other_low, other_high) == pytest.approx((1 - high, 1 - low))
