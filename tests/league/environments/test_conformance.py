"""What `check-env` says of environments: faults, notes, and what it has measured."""

import re
from collections.abc import Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from league.config.league import LeagueConfig
from league.environments.conformance import episodes, time_budget
from league.environments.conformance.examination import examine
from league.environments.conformance.findings import Examination
from league.environments.conformance.openings import OpeningLength, OpeningMeasurement, recommended
from policy_league.examples.kuhn_poker_vector import KuhnPokerVector
from tests.support.environments.simultaneous import Simultaneous
from tests.support.environments.unsound import (
    BrokenKuhnPoker,
    ConstantImages,
    DictActions,
    Endless,
    Forgetful,
    IgnoresSeed,
    OneRound,
    OutOfBounds,
    Shuffled,
    Signalling,
    Stateful,
    Unrewarding,
    WrongKuhnPoker,
    WrongShape,
)
from tests.support.findings import shortened

SUPPORT = "tests.support.environments"


MEETING, RLLIB_MEETING = f"{SUPPORT}.simultaneous:meeting", f"{SUPPORT}.simultaneous:rllib_meeting"


COUNTING, SPREAD = f"{SUPPORT}.counting:counting", "mpe2.simple_spread_v3"


ADVERSARY, CROSSING = "mpe2.simple_adversary_v3", "policy_league.examples.traffic:crossing"


CLASSIC, TWO_STEP = "pettingzoo.classic.", "policy_league.examples.two_step:"


@pytest.fixture(autouse=True, scope="module")
def short_examinations() -> Iterator[None]:
    """Few games, and short comparisons with stock environments."""
    with shortened():
        yield


@cache
def examined(entry_point: str) -> Examination:
    """What several tests look at."""
    return examine(league(entry_point))


def findings(examination: Examination, severity: str) -> str:
    return "\n".join(str(finding) for finding in examination.findings if finding.severity == severity)


def test_a_game_that_is_short_or_ends_early_gets_the_shortest_opening() -> None:
    lengths = [OpeningLength(0.1 * plies, 0.0 if plies <= 2 else 0.1) for plies in range(1, 9)]
    assert recommended(lengths, game=40) == 2, "longer ones end many games"
    assert recommended(lengths, game=3) == 1
    assert recommended([OpeningLength(0.02, 0.3)] * 8, game=40) == 1, "all end many games"
    assert recommended([OpeningLength(0.02, 0.0)] * 8, game=40) == 1, "longer ones add nothing"
    assert recommended([OpeningLength(0.005, 0.0)] * 8, game=40) == 0, "one position"


def league(entry_point: str | type, **kwargs: Any) -> LeagueConfig:
    if entry_point == CROSSING:
        return LeagueConfig.load("policy_league/configs/cars_and_lights.yaml")
    name = entry_point if isinstance(entry_point, str) else f"{entry_point.__module__}:{entry_point.__name__}"
    policies = {"policies": {"a": ["*_0"], "b": ["*_1"]}} if name.startswith("tests") else {}
    return LeagueConfig.from_mapping(
        {"league": "x", "environment": {"entry_point": name, "kwargs": kwargs}, **policies}
    )


def test_valid_environments_pass(subtests: pytest.Subtests) -> None:
    """Several agents act in one step, and removed agents are no step."""
    for entry_point, kwargs, lengths, actions in (
        (MEETING, {"leaves": [3, 3]}, [3] * 3, 3),
        (MEETING, {"leaves": [2, 7]}, [7] * 3, 7),
        (RLLIB_MEETING, {"ends": 5}, [5] * 3, 3),
        (COUNTING, {"lives": [3, 3]}, [6] * 3, 3),
        (SPREAD, {}, [25] * 3, 25),
        (f"{CLASSIC}leduc_holdem_v4", {}, None, None),
        (f"{CLASSIC}rps_v2", {}, None, None),
        (f"{SUPPORT}.rllib_two_step:multi_agent_env", {}, None, None),
        (CROSSING, {}, None, None),
    ):
        with subtests.test(entry_point=entry_point, kwargs=kwargs):
            examination = examine(league(entry_point, **kwargs)) if kwargs else examined(entry_point)
            assert examination.passed, examination.findings
            assert min(examination.lengths) > 0
            if lengths:
                assert (examination.lengths, examination.actions_per_episode) == (lengths, actions)


FINDINGS: list[tuple[str, str | type, dict[str, Any], str]] = [
    ("fault", "no_such_module:env", {}, "cannot import 'no_such_module'"),
    ("fault", IgnoresSeed, {}, "the same seed gives another episode"),
    ("fault", Forgetful, {}, "reset must clear all state; first: the observation in report 1, of"),
    ("fault", Shuffled, {"module": "random"}, r"the seed of reset(.|\n)*the generator of the module random;"),
    ("fault", Shuffled, {"module": "numpy.random"}, r"in each new environment(.|\n)*of the module numpy.random;"),
    ("fault", WrongShape, {}, r"agent_0 and 1 more: observes observation with shape \[4\], but its space has \[3\]"),
    ("fault", MEETING, {"bad_reward": float("nan")}, "agent_0: got a reward of nan"),
    (
        "fault",
        MEETING,
        {"crashes": [0]},
        r"simultaneous.py, line \d+, step 2 of the episode with seed 0\): RuntimeError",
    ),
    (
        "fault",
        Signalling,
        {},
        r"^outside of the main thread, where training plays too, .* \(.*unsound.py, line \d+, step 1 of the"
        r" episode with seed 0\): ValueError: signal only works in main thread.* limit times by timeouts",
    ),
    ("fault", ConstantImages, {}, "observes a constant image"),
    ("fault", DictActions, {}, "expected Discrete, MultiDiscrete or a Box of floats"),
    ("fault", Stateful, {"kind": "grows"}, "its global state has no fixed size; first: 2 numbers, after 1"),
    ("fault", Stateful, {"kind": "nan"}, "its global state has NaN or infinity"),
    ("note", Stateful, {"kind": "raises"}, "its global state, which .* cannot be read: RuntimeError: no"),
    ("note", OutOfBounds, {}, r"agent_0 and 1 more: .* not in .* observation\[1\] is 3, outside of \[0, 2\]"),
    ("note", Unrewarding, {}, "all rewards were 0"),
    ("note", Unrewarding, {"truncated": [0, 1]}, "all rewards were 0"),
    ("fault", Unrewarding, {"truncated": [0, 1], "any_length": True}, "does not report how its games end"),
    ("note", MEETING, {"truncated": [0, 1]}, "all episodes were truncated, none was terminated"),
    ("note", COUNTING, {}, "modified after they are returned"),
    ("note", f"{CLASSIC}connect_four_v3", {}, "play.opening_plies"),
]


def test_findings_say_what_is_wrong(subtests: pytest.Subtests) -> None:
    for severity, entry_point, kwargs, expected in FINDINGS:
        with subtests.test(entry_point=entry_point, kwargs=kwargs):
            is_stock = isinstance(entry_point, str) and not kwargs
            examination = examined(entry_point) if is_stock else examine(league(entry_point, **kwargs))
            assert re.search(expected, findings(examination, severity)), examination.findings
            assert examination.passed == (severity == "note")


class Slow(Simultaneous):
    """Seeds alone do not vary its games."""

    seconds = 0.0
    """What its steps have taken, by a clock that only they move."""

    def __init__(self) -> None:
        super().__init__(leaves=(1000, 1000))

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        Slow.seconds += 0.02
        return super().step(actions)

    def _observe(self, agent: str) -> np.ndarray:
        return np.array([self.time, 0, 0], np.float32)


def test_checks_of_a_slow_environment_are_cut_short_and_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = SimpleNamespace(monotonic=lambda: Slow.seconds, perf_counter=lambda: Slow.seconds)
    for module in (time_budget, episodes):
        monkeypatch.setattr(module, "time", clock)
    doing: list[str] = []
    examination = examine(league(Slow), seconds=1.0, progress=doing.append)
    assert examination.passed, examination.findings
    assert re.search(
        r"the checks were cut short after 1 s, because the environment takes 0.02\d* s per step: 1 of 3 episodes were"
        r" played, the last one only to step \d+, random openings were not measured, PettingZoo's API test was not run",
        findings(examination, "note"),
    )
    assert (examination.actions_per_episode, examination.openings) == (None, None)
    assert doing


def test_an_endless_episode_is_a_fault_that_names_the_limit() -> None:
    config = league(Endless)
    config = config.model_copy(update={"play": config.play.model_copy(update={"max_moves": 50})})
    assert "did not end within 50 steps (play.max_moves)" in findings(examine(config), "fault")
    assert "did not end within 20 steps" in findings(examine(config, steps=20), "note")


def test_teams_are_noticed(subtests: pytest.Subtests) -> None:
    for entry_point, least, most in (
        (SPREAD, 0.95, 0.999),
        (f"{TWO_STEP}parallel_env", 1.0, 1.0),
        (ADVERSARY, -1.0, 0.0),
        (f"{CLASSIC}connect_four_v3", -1.0, -1.0),
        (f"{CLASSIC}leduc_holdem_v4", -1.0, -1.0),
        (CROSSING, -1.0, 1.0),
    ):
        with subtests.test(entry_point=entry_point):
            examination = examined(entry_point)
            assert examination.agreement is not None
            assert least <= round(examination.agreement, 6) <= most
            if entry_point != CROSSING:
                assert examination.is_team == (least > 0)
                assert examination.is_team == ("are they one team?" in findings(examination, "note"))


def test_openings_are_recommended_where_seeds_repeat_one_game(subtests: pytest.Subtests) -> None:
    measured = examined(f"{CLASSIC}connect_four_v3").openings
    assert measured is not None
    assert measured.different_games == 1
    assert 2 <= measured.recommended <= 5
    assert [length.ended for length in measured.lengths[:6]] == [0.0] * 6
    assert measured.lengths[0].distinct == 7 / 100
    assert f"play.opening_plies: {measured.recommended} is recommended" in str(measured)
    for entry_point, kwargs, reason in (
        (SPREAD, {}, "random openings are not needed"),
        (f"{CLASSIC}leduc_holdem_v4", {}, "random openings are not needed"),
        *((OneRound, {"rounds": rounds}, "they are not recommended") for rounds in (1, 2, 20)),
    ):
        with subtests.test(entry_point=entry_point, kwargs=kwargs):
            examination = examine(league(entry_point, **kwargs)) if kwargs else examined(entry_point)
            assert examination.openings is not None
            assert examination.openings.recommended == 0
            assert reason in str(examination.openings)
            assert "set play.opening_plies" not in findings(examination, "note")


def test_openings_that_end_many_games_are_warned_of() -> None:
    measurement = OpeningMeasurement(1, 20, (OpeningLength(0.05, 0.4), OpeningLength(0.6, 0.5)), 1)
    assert "end 40.0% of them: play.opening_plies: 1 is recommended. Openings of 1 ply end many" in str(measurement)
    config = league(f"{CLASSIC}tictactoe_v3")
    config = config.model_copy(update={"play": config.play.model_copy(update={"opening_plies": 7})})
    assert re.search(
        r"play.opening_plies: 7 is long for this game. Random openings of 7 plies reach \d+ different positions in 100"
        r" games and end \d+.\d% of them",
        findings(examine(config), "note"),
    )


@pytest.mark.parametrize("game", ["pistonball_v6", pytest.param("cooperative_pong_v6", marks=pytest.mark.slow)])
def test_images_of_pettingzoo_are_rendered_without_a_render_mode(game: str) -> None:
    kwargs = {"n_pistons": 2} if game == "pistonball_v6" else {}
    environment = {"entry_point": f"pettingzoo.butterfly.{game}", "kwargs": {"max_cycles": 30, **kwargs}}
    policies = {"left": ["*_0"], "rest": ["*"]}
    config = LeagueConfig.from_mapping({"league": "x", "environment": environment, "policies": policies})
    examination = examine(config, episodes=1)
    assert examination.passed, examination.findings


def test_the_size_of_the_global_state_is_reported() -> None:
    assert examine(league(Stateful, kind="sound")).state_size == 6
    assert examined(f"{CLASSIC}rps_v2").state_size is None


def test_a_vectorised_environment_is_compared() -> None:
    for vector, fault in (
        (KuhnPokerVector, None),
        (WrongKuhnPoker, "the vectorised environment differs: .*reward"),
        (BrokenKuhnPoker, "the vectorised environment raised an exception: ZeroDivisionError: no cards"),
    ):
        kuhn, name = "policy_league.examples.kuhn_poker:env", f"{vector.__module__}:{vector.__name__}"
        environment = {"entry_point": kuhn, "vector": name}
        examination = examine(LeagueConfig.from_mapping({"league": "kuhn", "environment": environment}))
        if fault is None:
            assert examination.passed, examination.findings
            assert examination.vectorised is not None
            assert examination.vectorised.steps >= 100
            assert examination.vectorised.steps_per_second > 0
        else:
            assert examination.vectorised is None
            assert re.search(fault, findings(examination, "fault"))
