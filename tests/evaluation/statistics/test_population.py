import pytest

from evaluation.statistics.population import population
from league.results.sums import tally
from tests.support.leagues.payoff_matches import match

CYCLE = [match(pair, points) for pair in (("a", "b"), ("b", "c"), ("c", "a")) for points in ((1, 1), (1, 0)) * 20]


def test_a_cycle_is_shared_and_a_dominated_strategy_has_no_share() -> None:
    names = ("a", "b", "c", "d")
    shares = population(names, tally([*CYCLE, *[match((name, "d"), (1, 1)) for name in "abc" for _ in range(20)]]))
    assert shares is not None
    for estimates in (shares.alpha_rank, shares.nash):
        assert sum(each.value for each in estimates) == pytest.approx(1)
        assert estimates[3].value == pytest.approx(0, abs=1e-6)
        for each in estimates[:3]:
            assert each.value == pytest.approx(1 / 3, abs=1e-3)
    for each in shares.nash[:3]:
        assert each.low is not None
        assert each.high is not None
        assert 0.1 < each.low < 1 / 3 < each.high < 0.6


def test_without_a_complete_table_there_are_no_shares() -> None:
    assert population(("a", "b", "c", "d"), tally(CYCLE)) is None
