"""What training adds to the game of a league: stages of a curriculum, and wrappers."""

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from league.config.league import LeagueConfig
from league.environments.building import build, interface
from league.errors import ConfigError
from league.settings import Storage
from tests.support.learners import equal
from training.algorithms.curriculum import STAGE
from training.runs.train import check
from training.runs.trial import FROM_SCRATCH, StartState, Trial, TrialPlan

PPO = {"train_batch_size": 120, "minibatch_size": 60, "epochs": 1, "num_envs": 2, "hidden": [8]}
STAGES = [
    {"kwargs": {"max_cycles": 4}, "steps": 300},
    {"kwargs": {"max_cycles": 6, "local_ratio": {"uniform": [0.2, 0.8]}}, "until": {"return": -1e9}},
    {},
]


def league(environment_wrappers: Sequence[Any] = (), **training: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {
                "entry_point": "mpe2.simple_spread_v3",
                "kwargs": {"max_cycles": 10},
                "wrappers": list(environment_wrappers),
            },
            "sides": {"team": ["agent_*"]},
            "training": {"runners": 0, "strength": None} | training,
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
    config = league(curriculum=stages)
    with pytest.raises(ConfigError, match=message):
        check(config, interface(config))


def run(directory: Path, config: LeagueConfig, start: StartState = FROM_SCRATCH) -> tuple[list[dict[str, Any]], Any]:
    """The results of a trial, one for each checkpoint, and its last weights."""
    (directory / "checkpoints").mkdir(parents=True)
    plan = TrialPlan(start, directory / "checkpoints", directory / "end", Storage.at(directory))
    trial = Trial(
        {"league": config.model_dump(by_alias=True), "interface": interface(config).model_dump(), "plan": plan}
    )
    try:
        results = [trial.train()]
        while not results[-1]["done"]:
            results.append(trial.train())
        return results, trial.algorithm.learner_group.get_weights()
    finally:
        trial.stop()


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize("settings", [PPO, pytest.param(PPO | {"runners": 2}, marks=pytest.mark.slow)])
def test_training_resumed_within_a_stage_equals_uninterrupted_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any]
) -> None:
    """And a run from a version begins with the first stage."""
    monkeypatch.setattr("training.runs.trial.REPORT_SECONDS", math.inf)
    config = league(curriculum=STAGES, steps=2400, checkpoint_every=480, **settings)
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
    parent = results[0]
    start = StartState(Path(parent["checkpoint"]), parent["steps"], parent["steps"], 0.0)
    (first,), _ = run(tmp_path / "child", config.with_training(steps=120), start)
    assert (first[STAGE], first["length"]) == (1, 4)


STEP_COST = {"policy_league.examples.extending.shaping:StepCost": {"cost": 100.0}}


class Noisy(BaseParallelWrapper):
    """Appends a number to observations."""

    def observation_space(self, agent: str) -> gymnasium.Space[Any]:
        space = self.env.observation_space(agent)
        return gymnasium.spaces.Box(-np.inf, np.inf, (space.shape[0] + 1,), np.float32)


class Unbuilt(BaseParallelWrapper):
    def __init__(self, env: ParallelEnv) -> None:
        raise KeyError("cost")


def first_reward(config: Any) -> float:
    env = build(config)
    env.reset(seed=1)
    _, rewards, *_ = env.step(dict.fromkeys(env.agents, 0))
    env.close()
    return float(rewards["agent_0"])


def test_wrappers_of_training_do_not_change_the_game() -> None:
    config, plain = league(wrappers=[STEP_COST]), league()
    check(config, interface(config))
    assert config.game_digest() == plain.game_digest()
    assert config.environment.digest() == plain.environment.digest()
    assert first_reward(config.training_environment) == pytest.approx(first_reward(config.environment) - 100)
    assert list(config.training_code()) == list(STEP_COST)


def test_wrappers_of_the_environment_are_part_of_the_game() -> None:
    game = league(environment_wrappers=[STEP_COST]).game()
    assert f"environment.wrappers.{next(iter(STEP_COST))}" in game
    assert league(environment_wrappers=[STEP_COST]).environment.digest() != league().environment.digest()


@pytest.mark.parametrize(
    ("wrapper", "problem"),
    [
        (f"{__name__}:Noisy", r"agent_0 has observations in .*shape=\(19,\).* in training, but in "
                              r".*shape=\(18,\).* in matches"),
        (f"{__name__}:Unbuilt", r"Unbuilt \(number 1\) cannot be created \(.*test_curriculum\.py, line \d+\): KeyErr"),
        (f"{__name__}:first_reward", r"first_reward \(number 1\) cannot be created"),
        (f"{__name__}:str", r"has no 'str'"),
    ],
)  # fmt: skip
def test_a_wrapper_that_does_not_fit_is_refused(wrapper: str, problem: str) -> None:
    config = league(wrappers=[wrapper])
    with pytest.raises(ConfigError, match=re.compile(r"^training\.wrappers: .*" + problem)):
        check(config, interface(config))
