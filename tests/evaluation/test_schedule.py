from collections import Counter
from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.schedule import gauntlet, round_robin, scoring, verdict
from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch
from league.results.records import Schedule
from tests.evaluation.examples import config

CONFIG = config()
INTERFACE = interface(CONFIG)

names = st.lists(st.from_regex(r"tictactoe@[1-9]", fullmatch=True), min_size=2, max_size=6, unique=True)


def meetings(schedule: Schedule, until: int | None = None) -> Counter[frozenset[str]]:
    positions = range(schedule.length if until is None else until)
    return Counter(frozenset(schedule.contestants_at(position)) for position in positions)


@given(names, st.integers(1, 5))
def test_round_robin_is_balanced_at_every_round(contestants: list[str], blocks: int) -> None:
    schedule = round_robin(CONFIG, INTERFACE, contestants, blocks)
    pairs = {frozenset(pair) for pair in combinations(contestants, 2)}
    for rounds in range(1, blocks + 1):
        assert meetings(schedule, rounds * len(pairs)) == dict.fromkeys(pairs, rounds)
    assert schedule.length == blocks * len(pairs)


@given(names, names, st.integers(1, 3))
def test_in_a_gauntlet_every_challenger_meets_every_opponent(a: list[str], b: list[str], blocks: int) -> None:
    schedule = gauntlet(CONFIG, INTERFACE, a, b, blocks)
    assert meetings(schedule) == {frozenset((x, y)): blocks for x in a for y in b if x != y}


def test_a_verdict_is_between_two_for_as_long_as_the_gate_allows() -> None:
    schedule = verdict(CONFIG, INTERFACE, "tictactoe@2", "tictactoe@1")
    assert schedule.length == CONFIG.gate.max_blocks
    assert meetings(schedule) == {frozenset({"tictactoe@1", "tictactoe@2"}): schedule.length}
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
def test_whatever_changes_the_games_changes_id_and_seed(other: Schedule) -> None:
    schedule = round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 3)
    assert schedule.id != other.id
    assert schedule.seed != other.seed


def test_verdicts_of_other_gates_have_other_ids() -> None:
    other = config(gate={"elo1": 50, "max_blocks": CONFIG.gate.max_blocks})
    ids = {verdict(each, INTERFACE, "tictactoe@1", "script:random").id for each in (CONFIG, other)}
    assert len(ids) == 2


def test_seeds_of_a_schedule_differ() -> None:
    schedule = round_robin(CONFIG, INTERFACE, ["tictactoe@1", "script:random"], 500)
    assert len({schedule.seed_at(position) for position in range(500)}) == 500


def test_one_contestant_alone_has_no_schedule() -> None:
    with pytest.raises(EnvironmentMismatch, match="two contestants"):
        round_robin(CONFIG, INTERFACE, ["tictactoe@1"], 3)


def test_alike_sides_are_compared_in_the_game_and_others_by_side() -> None:
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
def test_sides_are_alike_when_their_agents_have_the_same_spaces(
    entry_point: str, sides: dict[str, list[str]] | None, expected: str
) -> None:
    has_roles = "push" in entry_point or "adversary" in entry_point
    policies = {"adversary": ["adversary_*"], "good": ["agent_*"]} if has_roles else {"shared": ["*"]}
    document = {"league": "mpe", "environment": {"entry_point": entry_point}, "policies": policies, "sides": sides}
    league = LeagueConfig.from_mapping(document)
    assert scoring(league, interface(league)) == expected


def test_a_league_may_say_whom_a_contestant_is_compared_with() -> None:
    """General-sum games between alike sides: how much either gets may matter more than who gets more."""
    general: LeagueConfig = config(play={"scoring": "side"})
    assert round_robin(general, INTERFACE, ["tictactoe@1", "script:random"], 3).scoring == "side"
    alone: LeagueConfig = config(play={"scoring": "game"}, sides={"both": ["player_*"]})
    with pytest.raises(ConfigError, match=r"play\.scoring: game compares sides"):
        round_robin(alone, interface(alone), ["tictactoe@1", "script:random"], 3)
