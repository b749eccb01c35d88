"""Schedules of training settings: their values, and their form in a configuration."""

import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.config.league import LeagueConfig
from league.config.ppo import PPOConfig
from league.config.schedules import AnnealingConfig, ScheduleProgress, scheduled_value
from league.errors import ConfigError

VALUES = st.floats(min_value=0, max_value=1)


STEPS = st.integers(min_value=0, max_value=10**7)


FRACTIONS = st.floats(min_value=0, max_value=1)


KINDS = st.sampled_from(["linear", "cosine"])


def at(steps: int = 0, budget: float = 0.0) -> ScheduleProgress:
    return ScheduleProgress(steps, budget)


@st.composite
def points(draw: st.DrawFn) -> tuple[tuple[int, float], ...]:
    steps = draw(st.lists(STEPS, min_size=1, max_size=6, unique=True))
    return tuple((step, draw(VALUES)) for step in sorted(steps))


@given(kind=KINDS, initial=VALUES, final=VALUES, first=FRACTIONS, second=FRACTIONS)
def test_an_annealed_value_moves_from_initial_to_final(
    kind: Any, initial: float, final: float, first: float, second: float
) -> None:
    schedule = AnnealingConfig(schedule=kind, initial=initial, final=final)
    earlier, later = (schedule.at(at(budget=share)) for share in sorted([first, second]))
    low, high = min(initial, final), max(initial, final)
    assert schedule.at(at(budget=0.0)) == initial
    assert schedule.at(at(budget=1.0)) == final
    assert low - 1e-12 <= earlier <= high + 1e-12
    assert (later - earlier) * (final - initial) >= -1e-12


@given(kind=KINDS, initial=VALUES, final=VALUES, length=st.integers(1, 10**7), step=STEPS, budget=FRACTIONS)
def test_a_schedule_in_steps_does_not_depend_on_the_budget(
    kind: Any, initial: float, final: float, length: int, step: int, budget: float
) -> None:
    in_steps = AnnealingConfig(schedule=kind, initial=initial, final=final, steps=length)
    of_budget = AnnealingConfig(schedule=kind, initial=initial, final=final)
    assert in_steps.at(at(step, budget)) == of_budget.at(at(budget=min(step / length, 1.0)))


@given(schedule=points(), step=STEPS)
def test_a_piecewise_value_lies_between_its_neighbours(schedule: tuple[tuple[int, float], ...], step: int) -> None:
    before = [value for at_step, value in schedule if at_step <= step][-1:]
    after = [value for at_step, value in schedule if at_step > step][:1]
    neighbours = before + after
    assert min(neighbours) - 1e-12 <= scheduled_value(schedule, at(step)) <= max(neighbours) + 1e-12
    assert [scheduled_value(schedule, at(at_step)) for at_step, _ in schedule] == [value for _, value in schedule]


@given(initial=VALUES, final=VALUES, length=st.integers(1, 10**7), step=STEPS)
def test_two_points_are_a_linear_schedule(initial: float, final: float, length: int, step: int) -> None:
    linear = AnnealingConfig(initial=initial, final=final, steps=length)
    assert scheduled_value(((0, initial), (length, final)), at(step)) == linear.at(at(step))


def test_an_interval_of_minutes_replaces_the_default_interval_of_steps() -> None:
    assert PPOConfig().checkpoint_steps == 200_000
    assert PPOConfig(checkpoint_minutes=5).checkpoint_steps is None
    assert PPOConfig(checkpoint_minutes=5, checkpoint_every=100).checkpoint_steps == 100
    assert PPOConfig(checkpoint_every=None).checkpoint_steps is None
    with pytest.raises(ConfigError, match=r"training\.checkpoint_every.*: .*greater than or equal to 1.*got 0"):
        league(checkpoint_every=0)


def league(**training: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {"league": "mini", "environment": {"entry_point": "x"}, "training": training}, source="mini.yaml"
    )


def test_schedules_survive_json() -> None:
    config = league(
        lr={"initial": 0.001, "final": 0},
        clip=[[0, 0.3], [1000, 0.1]],
        entropy=0.01,
        per_policy={
            "shared": {"lr": [[5, 1]], "entropy": {"schedule": "cosine", "initial": 1, "final": 0, "steps": 9}}
        },
    )
    assert config.training.clip == ((0, 0.3), (1000, 0.1))
    assert LeagueConfig.from_mapping(config.model_dump(mode="json", by_alias=True)) == config


def test_a_run_of_minutes_is_not_ended_by_the_default_number_of_steps() -> None:
    assert PPOConfig().budget_spent(500_000, seconds=9999) == 0.5
    assert PPOConfig(steps=1000, minutes=2).budget_spent(250, seconds=60) == 0.5, "whichever is spent first"
    assert PPOConfig(steps=1000, minutes=2).budget_spent(2000, seconds=0) == 1
    minutes = PPOConfig(minutes=3)
    assert minutes.max_steps is None
    assert minutes.budget_spent(10**9, seconds=90) == 0.5
    settings = league(steps=None).with_training(minutes=3).training
    assert (settings.max_steps, settings.minutes) == (None, 3), "--minutes with a configuration without `steps`"
    cosine = AnnealingConfig(schedule="cosine", initial=1, final=0)
    values = [cosine.at(at(budget=share)) for share in (0.25, 0.5, 0.75)]
    assert values == pytest.approx([0.8535534, 0.5, 0.1464466]), "slow at both ends"


def test_a_fault_of_a_schedule_is_reported_with_its_key(subtests: pytest.Subtests) -> None:
    pairs = "training.clip: expected [step, value] pairs with increasing steps, got "
    for training, message in (
        ({"lr": 0}, "training.lr: input should be greater than 0, got 0"),
        ({"lr": {"initial": 1}}, "training.lr.final: missing, but required"),
        ({"lr": {"initial": 1, "finall": 0}}, "training.lr.finall: unknown key, did you mean 'final'?"),
        (
            {"entropy": {"schedule": "cosin", "initial": 1, "final": 0}},
            "training.entropy.schedule: expected 'linear' or 'cosine', got 'cosin'",
        ),
        ({"entropy": {"initial": -1, "final": 0}}, "training.entropy.initial: input should be greater than or equal"),
        ({"clip": []}, f"{pairs}[]"),
        ({"clip": [[10, 1], [10, 2]]}, f"{pairs}[[10,"),
        ({"clip": [0.1, 0.2]}, "training.clip[0]: expected a list, got 0.1"),
        ({"per_policy": {"a": {"lr": {"initial": 1}}}}, "training.per_policy.a.lr.final: missing, but required"),
        ({"algorithm": "dqn", "lr": {"initial": 1, "final": 0}}, "training.lr: expected a number, got"),
    ):
        with subtests.test(training=training), pytest.raises(ConfigError, match=re.escape(message)):
            league(**training)
