"""When a run leaves the stages of its curriculum."""

from typing import Any

import pytest

from league.errors import ConfigError
from tests.support.leagues.training_leagues import small, tictactoe
from training.algorithms.curriculum import STAGE, UPDATES, Curriculum


def curriculum(*stages: dict[str, Any]) -> Curriculum:
    return Curriculum(tictactoe(curriculum=list(stages)).training.curriculum)


def test_a_stage_ends_after_its_steps() -> None:
    stages = curriculum({"steps": 100}, {"steps": 50}, {})
    stages.restart(1000)
    assert [stages.advance({}, steps) for steps in (1099, 1100, 1149, 1150, 9000)] == [False, True, False, True, False]
    assert stages.metrics() == {STAGE: 3.0}


def test_a_stage_ends_once_all_its_curves_are_high_in_succession() -> None:
    stages = curriculum({"until": {"return": 0.5, "opponents/script:random/score": 0.8}}, {})
    high = {"return": 0.5, "opponents/script:random/score": 0.9}
    one_low = [*[high] * (UPDATES - 1), high | {"return": 0.4}]
    unreported = {"return": 0.9}
    updates = [*one_low, *[high] * (UPDATES - 1), unreported, high]
    assert [stages.advance(update, 0) for update in updates] == [*[False] * (len(updates) - 1), True]


def test_the_state_continues_a_stage() -> None:
    stages, restored = (curriculum({"steps": 10}, {"until": {"return": 0.0}, "steps": 90}, {}) for _ in range(2))
    for steps in (5, 12, 20, 30):
        stages.advance({"return": 1.0}, steps)
    restored.set_state(stages.get_state())
    updates = [({"return": 1.0}, 40), ({"return": 1.0}, 50), ({"return": 1.0}, 60)]
    assert [restored.advance(*update) for update in updates] == [stages.advance(*update) for update in updates]
    assert restored.stage == stages.stage == 2


def test_without_a_curriculum_there_is_no_curve() -> None:
    stages = curriculum()
    assert (stages.advance({}, 10**9), stages.metrics()) == (False, {})


def test_invalid_stages_are_refused(subtests: pytest.Subtests) -> None:
    rows: list[tuple[list[dict[str, Any]], str]] = [
        ([{"kwargs": {}}, {}], "stage 1 never ends: expected steps or until"),
        ([{"steps": 5}], "stage 1 is the last one, which lasts until the end: remove steps and until"),
        ([{"steps": 0}, {}], "curriculum"),
        ([{"kwargs": {"n": {"choice": []}}}], r"n: expected choice: \[value, …\], got {'choice': \[\]}"),
        ([{"kwargs": {"n": {"uniform": [2, 1]}}}], r"n: expected uniform: \[low, high\] with low < high, got"),
    ]
    for stages, message in rows:
        with subtests.test(message), pytest.raises(ConfigError, match=message):
            tictactoe(curriculum=stages)


def test_arguments_of_a_stage_are_added_to_those_of_the_game() -> None:
    stages = [{"kwargs": {"max_cycles": 5}, "steps": 10}, {}]
    config = small("mpe2.simple_spread_v3", {"N": 3, "max_cycles": 25}, curriculum=stages)
    assert config.stage_environment(0).kwargs == {"N": 3, "max_cycles": 5}
    assert config.stage_environment(1).kwargs == config.environment.kwargs == {"N": 3, "max_cycles": 25}
    plain = config.with_training(curriculum=[])
    assert plain.stage_environment(0) == plain.training_environment
    assert plain.game_digest() == config.game_digest()


def test_random_arguments_depend_on_the_seed_of_the_episode_only() -> None:
    kwargs = {"a": {"uniform": [1, 3]}, "b": {"choice": ["x", "y", "z"]}, "c": {"uniform": 1, "other": 2}, "d": 4}
    (stage,) = tictactoe(curriculum=[{"kwargs": kwargs}]).training.curriculum
    draws = [stage.drawn(seed) for seed in range(60)]
    assert draws == [stage.drawn(seed) for seed in range(60)]
    assert all(1 <= draw["a"] <= 3 and draw["c"] == kwargs["c"] and draw["d"] == 4 for draw in draws)
    assert {draw["b"] for draw in draws} == {"x", "y", "z"}
    assert len({draw["a"] for draw in draws}) == 60
    assert stage.is_random
    assert [(part["a"], part["b"]) for part in stage.extremes()] == [(1, "x"), (3, "y"), (1, "z")]
