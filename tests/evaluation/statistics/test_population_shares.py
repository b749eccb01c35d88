from evaluation.statistics.payoff import tabulate
from evaluation.statistics.population import shares, without_holes
from league.results.records import Game, Match
from league.results.sums import tally
from tests.support.closeness import close


def matches_between(first: str, second: str, score: float, blocks: int = 40) -> list[Match]:
    games = tuple(Game((i, 1 - i), 0, (), (), (score, 1 - score), (score, 1 - score)) for i in range(2))
    return [Match(f"{first}{second}/{i}", "duel", "s", i, (first, second), i, "digest", games) for i in range(blocks)]


CYCLE = [
    *matches_between("rock", "scissors", 1.0),
    *matches_between("scissors", "paper", 1.0),
    *matches_between("paper", "rock", 1.0),
]
NAMES = ["rock", "paper", "scissors"]


def test_a_cycle_has_equal_shares() -> None:
    found = shares(tabulate(NAMES, ["a", "b"], tally(CYCLE)), tally(CYCLE))
    assert [share.ref for share in found] == NAMES
    for share in found:
        assert abs(share.alpha_rank - 1 / 3) < 1e-6
        assert abs(share.nash - 1 / 3) < 1e-6
        assert abs(share.value) < 1e-9
        assert share.alpha_rank_interval[0] <= share.alpha_rank <= share.alpha_rank_interval[1] + 1e-9


def test_a_contestant_that_loses_to_all_has_no_share() -> None:
    sums = tally([*CYCLE, *(match for name in NAMES for match in matches_between(name, "weakest", 1.0))])
    weakest = shares(tabulate([*NAMES, "weakest"], ["a", "b"], sums), sums)[-1]
    assert close((weakest.ref, weakest.nash, weakest.value), ("weakest", 0.0, -1.0), 1e-6)


def test_only_contestants_that_met_all_previous_ones_are_in_the_complete_table() -> None:
    sums = tally([*CYCLE, *matches_between("rock", "incomplete", 0.5)])
    payoff = tabulate(["incomplete", *NAMES], ["a", "b"], sums)
    assert without_holes(payoff) == ["incomplete", "rock"]
    assert shares(payoff, sums) == (), "two contestants need no shares"
    assert without_holes(tabulate([*NAMES, "incomplete"], ["a", "b"], sums)) == NAMES
