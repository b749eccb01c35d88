import math
import re
import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from league.config.environment import EnvironmentConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.environments import engines
from tests.support.leagues import registries
from tests.support.leagues.training_leagues import tictactoe
from tests.support.policies.graphs import masked_mlp
from training.algorithms.metrics import metric_names
from training.runs.trial import FROM_SCRATCH, StartState, Trial, TrialPlan, read_progress


@pytest.fixture
def a_report_per_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long the updates take on a busy machine."""
    monkeypatch.setattr("training.runs.trial.REPORT_SECONDS", math.inf)


SINCE_THE_LAST_CHECKPOINT: list[tuple[dict[str, Any], int, float, bool]] = [
    ({"checkpoint_every": 256}, 10, 0.0, False),
    ({"checkpoint_every": 256}, 100, 0.0, True),
    ({"checkpoint_every": 256, "steps": 300}, 300, 0.0, True),
    ({"checkpoint_every": None, "checkpoint_minutes": 59}, 200, 60.0, False),
    ({"checkpoint_every": None, "checkpoint_minutes": 40}, 200, 1200.0, True),
]
"""Settings, steps and seconds since then, and whether the end is saved."""


TICTACTOE = "pettingzoo.classic.tictactoe_v3"
MEMORY = {"recurrence": {"width": 4, "sequence": 4}, "normalize_values": True}


def trial(directory: Path, start: StartState = FROM_SCRATCH, environment: str = TICTACTOE, **training: Any) -> Trial:
    """A trial in this process with checkpoints below `directory`."""
    ppo_settings = {"train_batch_size": 128, "minibatch_size": 64, "epochs": 1}
    league = tictactoe(**({} if "algorithm" in training else ppo_settings), **training)
    league = league.model_copy(update={"environment": EnvironmentConfig(entry_point=environment)})
    (directory / "checkpoints").mkdir(parents=True, exist_ok=True)
    plan = TrialPlan(start, directory / "checkpoints", directory / "end", Storage.at(directory))
    interface_ = interface(league)
    return Trial({"league": league.model_dump(by_alias=True), "interface": interface_.model_dump(), "plan": plan})


@pytest.mark.usefixtures("ray_session")
def test_an_exception_of_the_start_is_raised_by_the_first_step(tmp_path: Path) -> None:
    """Of one that a constructor raises, Ray passes on the text only. What was started is stopped."""
    failed = trial(tmp_path, environment=f"{engines.__name__}:only_engine")
    with pytest.raises(ConfigError, match=r"cannot be created \(.*\): OSError: Address already in use$"):
        failed.step()
    failed.cleanup()
    assert engines.RUNNING == []


@pytest.mark.usefixtures("ray_session")
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"network": {"entry_point": "lost:Net"}, "hidden": [256, 256]}, "training.network: cannot import 'lost': "),
        ({"algorithm": "lost:Algorithm"}, "training.algorithm: cannot import 'lost': "),
        ({"algorithm": "marwil", "data": "/lost"}, "training.data: /lost/shared.parquet does not exist: "),
    ],
)
def test_what_the_node_of_a_trial_lacks_is_named(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    failed = trial(tmp_path, **settings)
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}.*$"):
        failed.step()
    failed.cleanup()


def run(trial: Trial) -> list[dict[str, Any]]:
    """All results of a trial until it is done."""
    results = [trial.train()]
    while not results[-1]["done"]:
        results.append(trial.train())
    return results


def weights(trial: Trial) -> dict[str, torch.Tensor]:
    return trial.algorithm.learner_group._learner.module["shared"].state_dict()


@pytest.mark.usefixtures("ray_session")
def test_the_end_of_the_time_soon_after_a_checkpoint_saves_no_near_duplicate(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    """A run that ends by its steps has a checkpoint of them, and a short run has one in any case."""
    ended = trial(tmp_path, minutes=60, checkpoint_every=10_000)
    ended.steps, ended.seconds = 128, 3600.0
    assert "checkpoint" in ended.step()
    league = ended.league
    for number, (settings, steps, seconds, is_saved) in enumerate(SINCE_THE_LAST_CHECKPOINT):
        with subtests.test(str(settings), steps=steps, seconds=seconds):
            ended.league = league.with_training(**settings)
            ended.plan = replace(ended.plan, checkpoints=tmp_path / str(number))
            ended.steps, ended.seconds = 128, 3600.0 - seconds
            ended._save()
            ended.steps += steps
            ended.seconds = 3600.0
            result = ended.step()
            assert (result["done"], result["spent"], "checkpoint" in result) == (True, True, is_saved)
    ended.stop()


@pytest.mark.usefixtures("ray_session", "a_report_per_checkpoint")
def test_checkpoints_are_saved_at_their_interval_with_the_curves(tmp_path: Path) -> None:
    complete = trial(tmp_path, steps=600, checkpoint_every=256)
    results = run(complete)
    complete.stop()
    assert [(result["steps"], "checkpoint" in result) for result in results] == [(256, True), (512, True), (640, True)]
    assert [Path(result["checkpoint"]).name for result in results] == ["256", "512", "640"]
    assert results[-1]["spent"]
    assert read_progress(tmp_path / "checkpoints" / "512") == (512, pytest.approx(results[1]["seconds"]))
    for result in results:
        assert metric_names(interface(complete.league)) <= result.keys()
        assert result["time/sampling"] > 0
        assert result["time/learning"] > 0
        assert result["time/other"] > 0
        assert result["episodes"] > 0
        assert result["crashes"] == 0
        assert result["shared/return"] == 0, "the game is zero-sum"
        assert result["agents/player_1/return"] == -result["agents/player_2/return"]
    assert any(result["agents/player_1/return"] for result in results)


@pytest.mark.usefixtures("ray_session", "a_report_per_checkpoint")
@pytest.mark.parametrize(
    "settings",
    [
        pytest.param({"environment": TICTACTOE, "runners": 1}, marks=pytest.mark.slow),
        {"environment": "pettingzoo.classic.leduc_holdem_v4", "seeds": "fast", "critic": "central", **MEMORY},
    ],
    ids=["remote runner", "fast seeds, central critic and memory"],
)
def test_restored_training_equals_uninterrupted_training(tmp_path: Path, settings: dict[str, Any]) -> None:
    """Weights, actions and schedules are identical. A remote runner's samples in flight are dropped in both."""
    settings = settings | {
        "threads": 2,
        "steps": 512,
        "checkpoint_every": 256,
        "opening_plies": 2,
        "lr": {"initial": 0.01, "final": 0},
        "entropy": {"schedule": "cosine", "initial": 0.05, "final": 0.01, "steps": 600},
        "clip": [[0, 0.3], [700, 0.1]],
        "teacher": {"ref": "script:random", "weight": 0.1},
    }
    uninterrupted = trial(tmp_path / "whole", **settings)
    assert torch.get_num_threads() == 2
    expected = run(uninterrupted)
    steps, seconds = read_progress(tmp_path / "whole" / "checkpoints" / "256")
    resumed = trial(
        tmp_path / "resumed", StartState(tmp_path / "whole" / "checkpoints" / "256", steps, 0, seconds), **settings
    )
    results = run(resumed)
    for name, value in weights(uninterrupted).items():
        assert torch.equal(weights(resumed)[name], value)
    learned = ["shared/length", "shared/policy_loss", "agents/player_1/return", "shared/kl", "steps"]
    learned += ["shared/lr", "shared/entropy_coefficient", "shared/clip"]
    rates = [result["shared/lr"] for result in expected]
    assert rates == pytest.approx([0.01 * (1 - steps / 512) for steps in (128, 384)])
    assert [[result[name] for name in learned] for result in results] == [
        [result[name] for name in learned] for result in expected[1:]
    ]
    uninterrupted.stop()
    resumed.stop()


@pytest.mark.usefixtures("ray_session")
def test_a_trial_that_is_asked_to_stop_saves_its_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.runs.trial.REPORT_SECONDS", 0.001)
    stopping = trial(tmp_path, steps=10**9, checkpoint_every=None)
    result = stopping.train()
    assert "checkpoint" not in result
    stopping.plan.stop_file.touch()
    result = stopping.train()
    assert (result["done"], result["spent"]) == (True, False)
    assert result["checkpoint"] == str(tmp_path / "checkpoints" / str(stopping.steps))
    stopping.stop()

    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "end").touch()
    at_once = trial(tmp_path / "again", StartState(Path(result["checkpoint"]), stopping.steps, 0, 1.0), steps=10**9)
    result = at_once.train()
    assert result["done"]
    assert "checkpoint" not in result, "nothing has changed since"
    at_once.stop()


@pytest.mark.usefixtures("ray_session", "a_report_per_checkpoint")
def test_restored_training_draws_the_same_opponents(tmp_path: Path) -> None:
    storage = Storage.at(tmp_path / "whole")
    with closing(Registry.open(storage)) as registry:
        registry.leagues.register(registries.config(), registries.interface())
        for number in range(4):
            graph = registries.builder(graph=masked_mlp((3, 3, 2), actions=9, seed=number))
            registry.publisher.publish("tictactoe", graph, source=f"run/{number}", parent=None)
    shutil.copytree(tmp_path / "whole", tmp_path / "resumed")
    league = {"share": 0.75, "sampling": "nash", "window": 3, "active": 2}
    settings: dict[str, Any] = {"steps": 512, "checkpoint_every": 256, "opponents": {"league": league}}
    whole = trial(tmp_path / "whole", **settings)
    expected = run(whole)
    start = StartState(tmp_path / "whole" / "checkpoints" / "256", 256, 0, 1.0)
    resumed = trial(tmp_path / "resumed", start, **settings)
    results = run(resumed)
    for name, value in weights(whole).items():
        assert torch.equal(weights(resumed)[name], value)

    def curves(result: dict[str, Any]) -> dict[str, float]:
        return {name: value for name, value in result.items() if name.startswith("opponents/")}

    assert list(map(curves, results)) == list(map(curves, expected[1:]))
    drawn = {name.split("/")[1] for result in expected for name in curves(result)}
    assert drawn == {"tictactoe@2", "tictactoe@3", "tictactoe@4"}
    assert resumed.algorithm.opponents.get_state()["scores"] == whole.algorithm.opponents.get_state()["scores"]
    whole.stop()
    resumed.stop()
