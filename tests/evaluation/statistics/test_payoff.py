"""Tables of payoffs, shares of a population, paired differences, improvement over runs, and spending of alpha."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import stdtrit
from scipy.stats import ttest_1samp

from evaluation.statistics.alpha_spending import alpha_per_verdict, alpha_share, alpha_spent
from evaluation.statistics.improvement import iqm, probability_of_improvement, stratified_bootstrap
from evaluation.statistics.payoff import crossed_interval, paired_difference, score_interval, student_interval, tabulate
from evaluation.statistics.population import population, resampled_interval, resampled_scores, shares, without_holes
from league.results.equilibria import alpha_rank, nash_averaging
from league.results.records import Game, Match
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
    tables = np.stack([ROCK_PAPER_SCISSORS, (TRANSITIVE + 1) / 2])
    assert alpha_rank(tables) == pytest.approx(np.stack([alpha_rank(table) for table in tables])), "at once"


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
        scores = np.delete(payoff[one], one)
        if len(scores) and (scores >= 0.25).all():
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


def test_an_incomplete_or_invalid_table_is_rejected() -> None:
    with pytest.raises(ValueError, match="a and c never met"):
        resampled_scores(("a", "b", "c"), tally([match(("a", "b"), (1, 0)), match(("b", "c"), (1, 0))]))
    for scores in ([0.5], [[0.5, 1.0], [0.5, 0.5]], np.zeros((2, 3))):
        with pytest.raises(ValueError, match="scores"):
            alpha_rank(scores)
        with pytest.raises(ValueError, match="antisymmetric"):
            nash_averaging(scores)


@given(st.lists(st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]), min_size=1), st.floats(0.5, 0.999))
def test_the_interval_of_a_score_contains_it(scores: list[float], confidence: float) -> None:
    """Wilson's interval of ten wins in ten games is [0.722, 1]."""
    assert score_interval([1.0] * 10) == pytest.approx((1.0, 0.72247, 1.0), abs=1e-5)
    mean, low, high = score_interval(scores, confidence)
    assert 0 <= low <= mean + 1e-12
    assert mean - 1e-12 <= high <= 1
    _, other_low, other_high = score_interval([1 - score for score in scores], confidence)
    assert (other_low, other_high) == pytest.approx((1 - high, 1 - low))


GAPS = (1.0, 2.5, -0.5, 3.0, 0.25)


@pytest.mark.parametrize("alone", [True, False])
def test_differences_are_paired_by_block(alone: bool) -> None:
    """Contestant 0 gets a gap more, on seeds of different values. One block has no interval."""
    matches = []
    for position, gap in enumerate(GAPS):
        score, opponent_score = position + gap, float(position)
        games = tuple(Game((i, 1 - i), 1, (), (), (score, opponent_score), (1.0, 0.0)) for i in range(2))
        if alone:
            first = Game((0,), 1, (), (), (score, None), (1.0, None))
            games = (first, Game((1,), 1, (), (), (None, opponent_score), (None, 0.0)))
        matches.append(Match(f"s/{position}", "league", "s", position, ("a", "b"), 1, "digest", games))
    interval = ttest_1samp(GAPS, 0).confidence_interval()
    gap = paired_difference(matches, "a")
    assert (gap.mean, gap.low, gap.high) == pytest.approx((np.mean(GAPS), interval.low, interval.high))
    reverse = paired_difference(matches, "b")
    assert (reverse.mean, reverse.low, reverse.high) == pytest.approx((-gap.mean, -interval.high, -interval.low))
    assert paired_difference([], "a") is None
    single = student_interval([2.0])
    assert close((single.mean, single.low, single.high), (2.0, None, None))


def test_intervals_have_their_coverage() -> None:
    """Of 5,000 series of 8 blocks, 95 % of the intervals contain the mean, up to three binomial standard errors."""
    values = np.random.default_rng(1).normal(3.0, 2.0, size=(5000, 8))
    covered = sum(
        low <= 3.0 <= high for low, high in ((s.low, s.high) for s in map(student_interval, values)) if low and high
    )
    assert covered / 5000 == pytest.approx(0.95, abs=3 * np.sqrt(0.05 * 0.95 / 5000))


def test_the_crossed_interval_counts_rows_and_columns() -> None:
    """Without an effect of one of them, it is Student's over the other."""
    rows = np.array([1.0, 2.0, 3.0])
    values = np.tile(GAPS, (3, 1))
    assert close(crossed_interval(values), student_interval(GAPS))
    assert close(crossed_interval(values.T), student_interval(GAPS))
    both = crossed_interval(rows[:, np.newaxis] + np.array(GAPS))
    assert both.mean == pytest.approx(rows.mean() + np.mean(GAPS))
    assert both.high - both.low > student_interval(GAPS).high - student_interval(GAPS).low
    single = crossed_interval(np.array([GAPS]))
    assert (single.mean, single.low, single.high) == (pytest.approx(np.mean(GAPS)), None, None)
    assert crossed_interval(np.zeros((2, 3))).low == 0


def cycle_of(names: Sequence[str], scores: Sequence[float] = (1, 1)) -> list[Match]:
    """Forty blocks of each pair of neighbours, in which the first one has these scores."""
    pairs = zip(names, [*names[1:], names[0]], strict=True)
    return [match(pair, scores) for pair in pairs for _ in range(40)]


def test_a_cycle_is_shared_and_a_dominated_strategy_has_no_share() -> None:
    cycle = [match(pair, points) for pair in (("a", "b"), ("b", "c"), ("c", "a")) for points in ((1, 1), (1, 0)) * 20]
    assert population("abcd", tally(cycle)) is None, "the table is incomplete"
    estimates = population("abcd", tally([*cycle, *[match((name, "d"), (1, 1)) for name in "abc" for _ in range(20)]]))
    for shares_of in (estimates.alpha_rank, estimates.nash):
        assert sum(share.value for share in shares_of) == pytest.approx(1)
        assert shares_of[3].value == pytest.approx(0, abs=1e-6)
        assert [share.value for share in shares_of[:3]] == pytest.approx([1 / 3] * 3, abs=1e-3)
    assert all(0.1 < share.low < 1 / 3 < share.high < 0.6 for share in estimates.nash[:3])


def test_shares_of_a_cycle_are_equal_and_a_contestant_that_loses_to_all_has_none() -> None:
    names = ["rock", "scissors", "paper"]
    sums = tally(cycle_of(names))
    table = shares(tabulate(names, SIDES, sums), sums)
    assert [share.ref for share in table] == names
    for share in table:
        assert abs(share.alpha_rank - 1 / 3) < 1e-6
        assert abs(share.nash - 1 / 3) < 1e-6
        assert abs(share.value) < 1e-9
        assert share.alpha_rank_interval[0] <= share.alpha_rank <= share.alpha_rank_interval[1] + 1e-9
    sums = tally([*cycle_of(names), *(match((name, "weakest"), (1, 1)) for name in names for _ in range(40))])
    weakest = shares(tabulate([*names, "weakest"], SIDES, sums), sums)[-1]
    assert close((weakest.ref, weakest.nash, weakest.value), ("weakest", 0.0, -1.0), 1e-6)


def test_only_contestants_that_met_all_previous_ones_are_in_the_complete_table() -> None:
    names = ["rock", "scissors", "paper"]
    sums = tally([*cycle_of(names), match(("rock", "incomplete"), (0.5, 0.5))])
    payoff = tabulate(["incomplete", *names], SIDES, sums)
    assert without_holes(payoff) == ["incomplete", "rock"]
    assert shares(payoff, sums) == (), "two contestants need no shares"
    assert without_holes(tabulate([*names, "incomplete"], SIDES, sums)) == names


MATRICES = arrays(np.float64, (6, 3), elements=st.integers(-20, 20).map(float))


def test_values_equal_those_of_rliable() -> None:
    scores = [[1, 2], [2, 2], [1, 1], [2, 1]]
    assert iqm(scores) == pytest.approx(1.5)
    assert probability_of_improvement(scores, [[1, 1], [2, 2], [3, 3]]) == pytest.approx(1 / 3)


@given(MATRICES)
def test_iqm_is_the_mean_of_the_middle_half(scores: np.ndarray) -> None:
    middle = np.sort(scores, axis=None)[4:-4]
    assert iqm(scores) == pytest.approx(middle.mean())


@given(MATRICES, MATRICES)
def test_improvement_and_its_opposite_sum_to_one(ours: np.ndarray, theirs: np.ndarray) -> None:
    forward, backward = probability_of_improvement(ours, theirs), probability_of_improvement(theirs, ours)
    assert forward + backward == pytest.approx(1)
    pairs = (ours[:, None] > theirs[None]) + 0.5 * (ours[:, None] == theirs[None])
    assert forward == pytest.approx(pairs.mean())


def test_the_interval_has_its_coverage() -> None:
    """With the mean, which is faster than the IQM; `benchmarks.simulations.coverage` measures the IQM's interval."""
    rng = np.random.default_rng(0)
    truth = covered = 0
    for seed in range(200):
        scores = rng.normal(size=(40, 5))
        interval = stratified_bootstrap(lambda resample: float(resample.mean()), scores, resamples=300, seed=seed)
        covered += interval.low <= truth <= interval.high
    assert 178 <= covered <= 199, "95 % of 200, within 3.5 standard deviations"


def test_the_interval_of_few_runs_is_as_wide_as_students() -> None:
    """Unexpanded percentiles of three runs are about a quarter too narrow."""
    runs, tasks = 3, 10
    scores = np.random.default_rng(0).normal(size=(runs, tasks))
    interval = stratified_bootstrap(lambda resample: float(resample.mean()), scores)
    error = np.sqrt(scores.var(axis=0, ddof=1).sum() / runs) / tasks
    expected = 2 * stdtrit(tasks * (runs - 1), 0.975) * error
    assert interval.high - interval.low == pytest.approx(expected, rel=0.1)


def test_intervals_are_reproducible_and_stratified_by_task() -> None:
    scores = np.array([[0.0, 100.0], [1.0, 101.0], [2.0, 102.0]])
    first, second = (stratified_bootstrap(iqm, scores, resamples=200, seed=3) for _ in range(2))
    assert close(first, second)
    assert 50 <= first.low <= first.value <= first.high <= 52, "each task contributes half of each resample"


def test_invalid_scores_of_runs_are_rejected() -> None:
    for scores in ([], [1.0, 2.0], [[float("nan")]], np.zeros((0, 3))):
        with pytest.raises(ValueError, match="matrix"):
            iqm(scores)
    with pytest.raises(ValueError, match="numbers of tasks differ"):
        probability_of_improvement([[1.0, 2.0]], [[1.0]])


@given(st.lists(st.integers(1, 20), min_size=1, max_size=365), st.floats(1e-6, 0.5))
def test_a_year_spends_at_most_alpha(candidates: list[int], alpha: float) -> None:
    assert sum(count * alpha_per_verdict(count, alpha) for count in candidates) <= alpha * (1 + 1e-9)
    assert alpha_per_verdict(8, 0.05) == pytest.approx(0.05 / 365 / 8)
    for arguments in ((0, 0.05), (1, 0.0), (1, 1.0), (1, 0.05, 0)):
        with pytest.raises(ValueError, match="expected"):
            alpha_per_verdict(*arguments)


NOW = datetime(2026, 1, 1, tzinfo=UTC)


@given(st.lists(st.tuples(st.integers(1, 8), st.floats(0, 400)), max_size=900), st.integers(1, 1000))
def test_no_365_days_spend_more_than_alpha(gaps: list[tuple[int, float]], nights: int) -> None:
    """Runs at any times, with any number of candidates, and a `nights` that may be far too small."""
    time, verdicts = NOW, []
    for candidates, hours in gaps:
        time += timedelta(hours=hours)
        part = alpha_share(candidates, 0.05, nights, alpha_spent(verdicts, time))
        assert 0 <= part <= 0.05 / nights / candidates
        verdicts += [(time, part)] * candidates
        assert alpha_spent(verdicts, time) <= 0.05 * (1 + 1e-9)


def test_alpha_spent_more_than_a_year_ago_is_ignored() -> None:
    old, new = (NOW - timedelta(days=366), 0.03), (NOW - timedelta(days=364), 0.04)
    assert alpha_spent([old, new], NOW) == pytest.approx(0.04)
    assert alpha_share(2, 0.05, 1, 0.04) == pytest.approx(0.005)
    assert alpha_share(2, 0.05, 1, 0.06) == pytest.approx(0.0, abs=0.0)
