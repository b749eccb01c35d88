"""Every algorithm on a GPU. `python -m pytest tests/training/test_gpu.py` on a machine with one."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import ray
import torch
from ray.rllib.algorithms.algorithm import Algorithm

from league.config.league import LeagueConfig
from league.environments.building import interface
from tests.support.algorithms import running
from training.export.publish import load_modules

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

ROOT = Path(__file__).parents[2]
MEMORY = {"width": 16, "sequence": 4}
PPO = {"train_batch_size": 256, "minibatch_size": 64, "epochs": 1}
OFF_POLICY = {"learning_starts": 64, "batch_size": 32}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "ppo": ("tictactoe", PPO),
    "ppo with an LSTM": ("tictactoe", PPO | {"recurrence": MEMORY}),
    "ppo with a shared encoder": ("shared_encoder", PPO),
    "ppo with a magnet": ("kuhn_poker", PPO),
    "ppo with a uniform magnet": ("kuhn_poker", PPO | {"magnet": {"ref": "uniform", "weight": 0.1}}),
    "ppo with a teacher": ("connect_four", PPO | {"opponents": [], "teacher": {"ref": "script:one_ply", "weight": 1}}),
    "ppo with images": ("pistonball_gpu", PPO),
    "ppo with continuous actions": ("simple_spread", PPO),
    "dqn": ("connect_four_dqn", OFF_POLICY),
    "dqn with a GRU": ("connect_four_dqn", OFF_POLICY | {"recurrence": MEMORY, "n_step": 1, "priorities": None}),
    "qmix": ("simple_spread_qmix", OFF_POLICY),
    "qmix with a GRU": ("simple_spread_qmix", OFF_POLICY | {"recurrence": MEMORY}),
    "maddpg": ("simple_adversary", OFF_POLICY),
}


@pytest.fixture(scope="module", autouse=True)
def ray_with_a_gpu() -> Iterator[None]:
    ray.init(address="local", num_cpus=2, num_gpus=1, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


def modules(algorithm: Algorithm) -> dict[str, dict[str, torch.Tensor]]:
    learner = algorithm.learner_group._learner
    return {policy: module.state_dict() for policy, module in learner.module.items()}


@pytest.mark.parametrize("case", CASES)
def test_the_learner_and_the_runner_use_the_gpu_and_the_cpu_continues(case: str, tmp_path: Path) -> None:
    name, changes = CASES[case]
    league = LeagueConfig.load(ROOT / f"policy_league/configs/{name}.yaml").with_training(
        runners=0, num_envs=8, **changes
    )
    with running(league.with_training(gpus=0.5, runner_gpus=0.5)) as algorithm:
        for _ in range(3):
            learned = algorithm.train()["learners"]
        before = modules(algorithm)
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
    policies = [statistics for policy, statistics in learned.items() if not policy.startswith("__")]
    assert policies
    assert all(math.isfinite(value) for statistics in policies for value in statistics.values())
    assert all(value.is_cuda for state in before.values() for value in state.values())
    for gpus in (0, 1):
        with running(league.with_training(gpus=gpus), tmp_path / "checkpoint") as algorithm:
            for policy, state in modules(algorithm).items():
                for key, value in state.items():
                    assert value.is_cuda == bool(gpus)
                    assert torch.equal(value.cpu(), before[policy][key].cpu())
            algorithm.train()
    published = load_modules(tmp_path / "checkpoint", league, interface(league))
    assert not any(value.is_cuda for module in published.values() for value in module.state_dict().values())
