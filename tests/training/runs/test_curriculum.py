"""Curricula in training: refused, resumed and with remote runners."""

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.settings import Storage
from training.algorithms.curriculum import STAGE
from training.runs.train import check
from training.runs.trial import FROM_SCRATCH, StartState, Trial, TrialPlan

PPO = {"train_batch_size": 120, "minibatch_size": 60, "epochs": 1, "num_envs": 2, "hidden": [8]}
STAGES = [
    {"kwargs": {"max_cycles": 4}, "steps": 300},
    {"kwargs": {"max_cycles": 6, "local_ratio": {"uniform": [0.2, 0.8]}}, "until": {"return": -1e9}},
    {},
]


def league(stages: list[dict[str, Any]], **training: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 10}},
            "sides": {"team": ["agent_*"]},
            "training": {"curriculum": stages, "runners": 0, "strength": None} | training,
        }
    )


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ([{"kwargs": {"N": 2}, "steps": 5}, {}], r"stage 1: agent_0 has observations in .*\(12,\).* but in .*\(18,\)"),
        ([{"steps": 5}, {"kwargs": {"N": {"choice": [3, 4]}}}], r"stage 2: agent_0 has observations in"),
        ([{"steps": 5}, {"kwargs": {"cycles": 4}}], r"stage 2: mpe2.simple_spread_v3 does not accept them: .*cycles"),
        ([{"until": {"retrun": 5}}, {}], r"stage 1: until: unknown curve 'retrun', expected for example return"),
    ],
)
def test_stages_that_do_not_fit_the_game_are_refused(stages: list[dict[str, Any]], message: str) -> None:
    config = league(stages)
    with pytest.raises(ConfigError, match=message):
        check(config, interface(config))


def trial(directory: Path, config: LeagueConfig, start: StartState = FROM_SCRATCH) -> Trial:
    (directory / "checkpoints").mkdir(parents=True, exist_ok=True)
    plan = TrialPlan(start, directory / "checkpoints", directory / "end", Storage.at(directory))
    return Trial(
        {"league": config.model_dump(by_alias=True), "interface": interface(config).model_dump(), "plan": plan}
    )


def run(directory: Path, config: LeagueConfig, start: StartState = FROM_SCRATCH) -> tuple[list[dict[str, Any]], Any]:
    """The results of a trial, one for each checkpoint, and its last weights."""
    training = trial(directory, config, start)
    try:
        results = [training.train()]
        while not results[-1]["done"]:
            results.append(training.train())
        return results, training.algorithm.learner_group.get_weights()
    finally:
        training.stop()


def equal(some: Any, others: Any) -> bool:
    if isinstance(some, dict):
        return some.keys() == others.keys() and all(equal(some[name], others[name]) for name in some)
    return torch.equal(torch.as_tensor(some), torch.as_tensor(others))


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("settings", [PPO, pytest.param(PPO | {"runners": 2}, marks=pytest.mark.slow)])
def test_training_resumed_within_a_stage_equals_uninterrupted_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any]
) -> None:
    monkeypatch.setattr("training.runs.trial.REPORT_SECONDS", math.inf)
    config = league(STAGES, steps=2400, checkpoint_every=480, **settings)
    results, weights = run(tmp_path / "whole", config)
    stages = [result[STAGE] for result in results]
    assert (stages[0], stages[-1]) == (2.0, 3.0), "checkpoints are within the second and the last stage"
    lengths = {result[STAGE]: result["length"] for result in results}
    assert (lengths[2.0], lengths[3.0]) == (6, 10)
    for result in (results[0], results[-2]):
        path = Path(result["checkpoint"])
        start = StartState(path, int(path.name), 0, result["seconds"])
        resumed, resumed_weights = run(tmp_path / f"from {path.name}", config, start)
        assert [part[STAGE] for part in resumed] == [part[STAGE] for part in results if part["steps"] > start.steps]
        assert equal(resumed_weights, weights)


@pytest.mark.usefixtures("ray_session")
def test_a_run_from_a_version_begins_with_the_first_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.runs.trial.REPORT_SECONDS", math.inf)
    config = league(STAGES, steps=480, checkpoint_every=480, **PPO)
    (result,), _ = run(tmp_path / "parent", config)
    start = StartState(Path(result["checkpoint"]), result["steps"], result["steps"], 0.0)
    (first,), _ = run(tmp_path / "child", config.with_training(steps=120), start)
    assert (first[STAGE], first["length"]) == (1, 4)
