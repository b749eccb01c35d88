from collections import Counter
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.schedules.builders import gauntlet, round_robin, verdict
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch
from league.results.records import Schedule
from league.results.scoring import scoring
from tests.support.leagues.schedules import CONFIG, INTERFACE
from tests.support.leagues.tictactoe import config

names = st.lists(st.from_regex(r"tictactoe@[1-9]", fullmatch=True), min_size=2, max_size=6, unique=True)


def pair_counts(schedule: Schedule, until: int | None = None) -> Counter[frozenset[str]]:
    positions = range(schedule.length if until is None else until)
    return Counter(frozenset(schedule.contestants_at(position)) for position in positions)


@given(names, st.integers(1, 5))
def test_a_round_robin_is_balanced_after_each_round(contestants: list[str], blocks: int) -> None:
    schedule = round_robin(CONFIG, INTERFACE, contestants, blocks)
    pairs = {frozenset(pair) for pair in combinations(contestants, 2)}
    for rounds in range(1, blocks + 1):
        assert pair_counts(schedule, rounds * len(pairs)) == dict.fromkeys(pairs, rounds)
    assert schedule.length == blocks * len(pairs)


@given(names, names, st.integers(1, 3))
def test_in_a_gauntlet_each_challenger_meets_each_opponent(a: list[str], b: list[str], blocks: int) -> None:
    schedule = gauntlet(CONFIG, INTERFACE, a, b, blocks)
    assert pair_counts(schedule) == {frozenset((x, y)): blocks for x in a for y in b if x != y}


def test_a_verdict_has_two_contestants_and_the_length_of_the_gate() -> None:
    schedule = verdict(CONFIG, INTERFACE, "tictactoe@2", "tictactoe@1")
    assert schedule.length == CONFIG.gate.max_blocks
    assert pair_counts(schedule) == {frozenset({"tictactoe@1", "tictactoe@2"}): schedule.length}
    assert schedule.contestants[0] == "tictactoe@2"


def test_the_same_arguments_give_the_same_schedule() -> None:
    one, two = (round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 3) for _ in range(2))
    assert one == two


@pytest.mark.parametrize(
    "other",
    [
        round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 3, seed=1),
        round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 4),
        round_robin(CONFIG, INTERFACE, ["tictactoe@2", "script:random"], 3),
        round_robin(config(play={"opening_plies": 3}), INTERFACE, ["tictactoe@1", "script:random"], 3),
        verdict(CONFIG, INTERFACE, "tictactoe@1", "script:random"),
    ],
)
def test_each_setting_of_the_games_changes_id_and_seed(other: Schedule) -> None:
    schedule = round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 3)
    assert schedule.id != other.id
    assert schedule.seed != other.seed


def test_verdicts_of_different_gates_have_different_ids() -> None:
    other = config(gate={"elo1": 50, "max_blocks": CONFIG.gate.max_blocks})
    ids = {verdict(each, INTERFACE, "tictactoe@1", "script:random").id for each in (CONFIG, other)}
    assert len(ids) == 2


def test_seeds_of_a_schedule_differ() -> None:
    schedule = round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 500)
    assert len({schedule.seed_at(position) for position in range(500)}) == 500


def test_a_single_contestant_has_no_schedule() -> None:
    with pytest.raises(EnvironmentMismatch, match="two contestants"):
        round_robin(CONFIG, INTERFACE, ["tictactoe@1"], 3)


def test_equal_sides_are_compared_within_a_game_and_others_by_side() -> None:
    assert round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 3).scoring == "game"
    one: LeagueConfig = config(sides={"both": ["player_*"]})
    assert round_robin(one, interface(one), ["tictactoe@1", "script:random"], 3).scoring == "side"


@pytest.mark.parametrize(
    ("entry_point", "sides", "expected"),
    [
        ("mpe2.simple_spread_v3", None, "game"),
        ("mpe2.simple_spread_v3", {"team": ["*"]}, "side"),
        ("mpe2.simple_push_v3", None, "side"),
        ("mpe2.simple_adversary_v3", {"adversary": ["adversary_*"], "good": ["*"]}, "side"),
        ("mpe2.simple_v3", None, "side"),
    ],
)
def test_sides_are_equal_if_their_agents_have_the_same_spaces(
    entry_point: str, sides: dict[str, list[str]] | None, expected: str
) -> None:
    has_roles = "push" in entry_point or "adversary" in entry_point
    policies = {"adversary": ["adversary_*"], "good": ["agent_*"]} if has_roles else {"shared": ["*"]}
    document = {"league": "mpe", "environment": {"entry_point": entry_point}, "policies": policies, "sides": sides}
    league = LeagueConfig.from_mapping(document)
    assert scoring(league, interface(league)) == expected


def test_the_scoring_can_be_configured() -> None:
    """In general-sum games the amount of the return may matter more than who gets more."""
    general: LeagueConfig = config(play={"scoring": "side"})
    assert round_robin(general, INTERFACE, ["tictactoe@1", "script:random"], 3).scoring == "side"
    invalid: LeagueConfig = config(play={"scoring": "game"}, sides={"both": ["player_*"]})
    with pytest.raises(ConfigError, match=r"play\.scoring: game compares the sides"):
        round_robin(invalid, interface(invalid), ["tictactoe@1", "script:random"], 3)
