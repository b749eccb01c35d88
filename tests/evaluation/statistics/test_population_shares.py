from evaluation.statistics.payoff import tabulate
from evaluation.statistics.population import shares, without_holes
from league.results.records import Game, Match
from tests.support.closeness import close


def matches_between(first: str, second: str, score: float, blocks: int = 40) -> list[Match]:
    game = Game((0, 1), 0, (), (), (score, 1 - score), (score, 1 - score))
    return [
        Match(f"{first}{second}/{i}", "duel", "s", i, (first, second), i, "digest", (game, game)) for i in range(blocks)
    ]


CYCLE = [
    *matches_between("rock", "scissors", 1.0),
    *matches_between("scissors", "paper", 1.0),
    *matches_between("paper", "rock", 1.0),
]
NAMES = ["rock", "paper", "scissors"]


def test_a_cycle_has_equal_shares() -> None:
    found = shares(tabulate(NAMES, ["a", "b"], CYCLE), CYCLE)
    assert [share.ref for share in found] == NAMES
    for share in found:
        assert abs(share.alpha_rank - 1 / 3) < 1e-6
        assert abs(share.nash - 1 / 3) < 1e-6
        assert abs(share.value) < 1e-9
        assert share.alpha_rank_interval[0] <= share.alpha_rank <= share.alpha_rank_interval[1] + 1e-9


def test_a_contestant_that_loses_to_all_has_no_share() -> None:
    matches = [*CYCLE, *(match for name in NAMES for match in matches_between(name, "weakest", 1.0))]
    weakest = shares(tabulate([*NAMES, "weakest"], ["a", "b"], matches), matches)[-1]
    assert close((weakest.ref, weakest.nash, weakest.value), ("weakest", 0.0, -1.0), 1e-6)


def test_only_contestants_that_met_all_previous_ones_are_in_the_complete_table() -> None:
    matches = [*CYCLE, *matches_between("rock", "incomplete", 0.5)]
    payoff = tabulate(["incomplete", *NAMES], ["a", "b"], matches)
    assert without_holes(payoff) == ["incomplete", "rock"]
    assert shares(payoff, matches) == (), "two contestants need no shares"
    assert without_holes(tabulate([*NAMES, "incomplete"], ["a", "b"], matches)) == NAMES
