from evaluation.pages.shares import shares, without_holes
from evaluation.payoff import tabulate
from league.results.records import Game, Match


def meeting(first: str, second: str, score: float, blocks: int = 40) -> list[Match]:
    game = Game((0, 1), 0, (), (), (score, 1 - score), (score, 1 - score))
    return [
        Match(f"{first}{second}/{i}", "duel", "s", i, (first, second), i, "digest", (game, game)) for i in range(blocks)
    ]


CIRCLE = [*meeting("rock", "scissors", 1.0), *meeting("scissors", "paper", 1.0), *meeting("paper", "rock", 1.0)]
NAMES = ["rock", "paper", "scissors"]


def test_a_circle_shares() -> None:
    found = shares(tabulate(NAMES, ["a", "b"], CIRCLE), CIRCLE)
    assert [share.ref for share in found] == NAMES
    for share in found:
        assert abs(share.alpha_rank - 1 / 3) < 1e-6
        assert abs(share.nash - 1 / 3) < 1e-6
        assert abs(share.value) < 1e-9
        assert share.alpha_rank_interval[0] <= share.alpha_rank <= share.alpha_rank_interval[1] + 1e-9


def test_who_loses_to_all_has_no_share() -> None:
    matches = [*CIRCLE, *(match for name in NAMES for match in meeting(name, "lamb", 1.0))]
    lamb = shares(tabulate([*NAMES, "lamb"], ["a", "b"], matches), matches)[-1]
    assert (lamb.ref, round(lamb.nash, 6), lamb.value) == ("lamb", 0, -1)


def test_only_who_has_met_all_before_it_is_in_the_table_without_holes() -> None:
    matches = [*CIRCLE, *meeting("rock", "stranger", 0.5)]
    payoff = tabulate(["stranger", *NAMES], ["a", "b"], matches)
    assert without_holes(payoff) == ["stranger", "rock"]
    assert shares(payoff, matches) == (), "two have a score, and need no shares"
    assert without_holes(tabulate([*NAMES, "stranger"], ["a", "b"], matches)) == NAMES
