import json
import math
import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.sweep import SweepConfig
from league.errors import ConfigError
from tests.support.leagues.training_leagues import tictactoe
from training.sweeps.search_space import Settings, TrialOutcome, applied, format_settings, nested, plan, propose


def sweep(parameters: dict[str, Any], samples: int = 1, **settings: Any) -> SweepConfig:
    return SweepConfig(parameters=parameters, samples=samples, **settings)


def outcome(score: float | None, *, ended_early: bool = False) -> TrialOutcome:
    return TrialOutcome(score=score, steps=256, seconds=1.0, ended_early=ended_early)


def test_trials_are_all_combinations_with_separate_draws() -> None:
    trials = plan(tictactoe(), sweep({"lr": {"loguniform": [1e-4, 1e-2]}, "clip": [0.1, 0.2], "epochs": [2, 3]}, 2))
    assert [(trial["clip"], trial["epochs"]) for trial in trials] == [
        (0.1, 2), (0.2, 2), (0.1, 3), (0.2, 3), (0.1, 2), (0.2, 2), (0.1, 3), (0.2, 3),
    ]  # fmt: skip
    assert len({trial["lr"] for trial in trials}) == 8
    assert [list(trial) for trial in trials] == [["lr", "clip", "epochs"]] * 8, "in the order of the configuration"


def test_the_seed_determines_the_draws() -> None:
    parameters = sweep({"lr": {"uniform": [0.1, 0.2]}}, samples=3)
    assert plan(tictactoe(seed=1), parameters) == plan(tictactoe(seed=1), parameters)
    assert plan(tictactoe(seed=1), parameters) != plan(tictactoe(seed=2), parameters)


@given(st.integers(0, 1000), st.floats(1e-6, 1.0), st.floats(1.001, 100.0))
@settings(max_examples=40)
def test_draws_are_within_their_range(seed: int, low: float, factor: float) -> None:
    bounds = [low, low * factor]
    parameters = {
        "uniform": {"uniform": bounds},
        "loguniform": {"loguniform": bounds},
        "randint": {"randint": [3, 5]},
        "choice": {"choice": ["a", "b"]},
        "quniform": {"quniform": [-1, 1, 0.5]},
        "lograndint": {"lograndint": [3, 20]},
        "randn": {"randn": [0, 1]},
        "value": {"choice": [{"nested": [1, 2]}]},
    }
    for trial in plan(tictactoe(seed=seed), sweep(parameters, samples=4)):
        assert bounds[0] <= trial["uniform"] <= bounds[1]
        assert bounds[0] <= trial["loguniform"] <= bounds[1]
        assert trial["randint"] in (3, 4)
        assert trial["choice"] in ("a", "b")
        assert trial["quniform"] in (-1, -0.5, 0, 0.5, 1)
        assert 3 <= trial["lograndint"] < 20
        assert isinstance(trial["randn"], float)
        assert trial["value"] == {"nested": [1, 2]}


def test_invalid_parameters_are_rejected(subtests: pytest.Subtests) -> None:
    rows: list[tuple[Any, str]] = [
        ([], "at least one value"),
        ({"lognormal": [1, 2]}, "one of choice, uniform"),
        ({"uniform": [1, 2], "choice": [1]}, "one of choice, uniform"),
        ({"uniform": [2, 1]}, "low < high"),
        ({"uniform": [1]}, "low < high"),
        ({"uniform": ["a", "b"]}, "low < high"),
        ({"loguniform": [0, 1]}, "0 < low"),
        ({"randint": [0.5, 2]}, "whole numbers"),
        ({"choice": 1}, r"choice: \[value"),
        ({"choice": []}, r"choice: \[value"),
        ({"quniform": [0, 1]}, r"\[low, high, step\]"),
        ({"quniform": [0, 1, 0]}, r"\[low, high, step\]"),
        ({"quniform": [0, 1, 0.3]}, r"\[low, high, step\] .* not divisible"),
    ]
    for values, expected in rows:
        message = rf"sweep\.parameters\.lr: expected .*{expected}"
        with subtests.test(values), pytest.raises(ConfigError, match=message):
            plan(tictactoe(), sweep({"lr": values}))


SPACE = {
    "lr": {"loguniform": [1e-5, 1e-1]},
    "hidden": [[64, 64], [128]],
    "clip": {"quniform": [0.1, 0.4, 0.1]},
    "epochs": {"randint": [1, 9]},
    "per_policy.shared.gamma": {"choice": [0.97, 0.99]},
}


@pytest.mark.parametrize("mode", ["max", "min"])
def test_optuna_proposes_what_was_better(mode: str) -> None:
    """The score is best at lr = 10⁻³. Trials that failed, ended early or are running belong to the history, too."""
    pytest.importorskip("optuna")
    config, search = tictactoe(), sweep(SPACE, 40, search="optuna", mode=mode)
    trials: list[tuple[Settings, TrialOutcome | None]] = []
    for number in range(40):
        settings = propose(config, search, trials)
        assert list(settings) == list(SPACE)
        applied(config, settings)
        loss = abs(math.log10(settings["lr"]) + 3)
        score = outcome(loss if mode == "min" else -loss, ended_early=loss > 1)
        trials.append((settings, {5: None, 7: outcome(None)}.get(number, score)))
    losses = [abs(math.log10(settings["lr"]) + 3) for settings, _ in trials]
    assert sum(losses[20:]) / 20 < 0.6, "of random draws, it is 1 on average"


def test_a_proposal_depends_on_the_seed_and_the_recorded_trials_only() -> None:
    pytest.importorskip("optuna")
    search = sweep(SPACE, 3, search="optuna")
    first = propose(tictactoe(), search, [])
    assert propose(tictactoe(), search, []) == first
    assert propose(tictactoe(seed=2), search, []) != first
    assert propose(tictactoe(), search, [], attempt=1) != first
    past = [(json.loads(json.dumps(first)), outcome(0.5))]
    assert propose(tictactoe(), search, past) == propose(tictactoe(), search, [(first, outcome(0.5))]) != first


@pytest.mark.parametrize("distribution", [{"randn": [0, 1]}, {"qloguniform": [0.1, 1, 0.1]}])
def test_distributions_that_optuna_lacks_are_rejected(distribution: dict[str, Any]) -> None:
    pytest.importorskip("optuna")
    with pytest.raises(ConfigError, match=r"sweep\.parameters\.lr: expected .*, lograndint with search: optuna, got"):
        propose(tictactoe(), sweep({"lr": distribution}, search="optuna"), [])


def test_without_optuna_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=r"search: optuna requires Optuna: pip install 'policy-league\[optuna\]'"):
        propose(tictactoe(), sweep(SPACE, search="optuna"), [])


def test_nested_settings_are_applied() -> None:
    settings = {"lr": 0.5, "per_policy.shared.entropy": 0.25, "recurrence.width": 7, "hidden": [4]}
    training = applied(tictactoe(recurrence=None), settings).training
    assert (training.lr, training.per_policy["shared"].entropy, training.hidden) == (0.5, 0.25, (4,))
    assert training.recurrence is not None
    assert training.recurrence.width == 7
    assert nested(settings) == {
        "lr": 0.5, "per_policy": {"shared": {"entropy": 0.25}}, "recurrence": {"width": 7}, "hidden": [4],
    }  # fmt: skip


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"lrr": 1}, "did you mean 'lr'"),
        ({"lr": -1}, r"training\.lr"),
        ({"lr.shared": 1}, r"training\.lr has no nested settings"),
        ({"per_policy.shared.width": 1}, r"per_policy\.shared\.width"),
        ({"minibatch_size": 512, "train_batch_size": 256}, "minibatch_size must be at most"),
    ],
)
def test_invalid_settings_are_rejected(settings: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        applied(tictactoe(), settings)


def test_settings_are_shown_with_a_few_digits() -> None:
    assert format_settings({"lr": 0.00012345678, "hidden": [64, 64], "clip": 0.2}) == (
        "lr 0.0001235, hidden [64, 64], clip 0.2"
    )
