"""Models of PyTorch: `torch.export` programs, modules of RLlib, and files of Stable-Baselines3."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo.torch.default_ppo_torch_rl_module import DefaultPPOTorchRLModule
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from torch import nn

from league.errors import ConfigError, EnvironmentMismatch
from league.interface import AgentInterface, Interface
from league.policies.onnx import OnnxPolicy
from league.policies.probes import excused
from league.spaces import DictSpace
from league.spaces.conversion import from_gymnasium
from training.importing.adapted_graph import adapt
from training.importing.open_source import open_sources
from training.importing.source import Source, known_logits

ROWS = 300
SEEN = gymnasium.spaces.Box(-9.0, 9.0, (4,), np.float32)
FIVE = gymnasium.spaces.Discrete(5)
STEERED = gymnasium.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32))
MODULES = Path("learner_group", "learner", "rl_module")


def interface(action: gymnasium.Space[Any]) -> Interface:
    spaces = AgentInterface(observation=from_gymnasium(SEEN), action=from_gymnasium(action))
    return Interface(agents={"agent": spaces}, policies={"agent": "shared"}, sides={"agent": ("agent",)})


def assert_equal_actions(source: Source, action: gymnasium.Space[Any]) -> None:
    spaces = interface(action).of_policy("shared")
    rng = np.random.default_rng(0)
    observations = {"observation": rng.uniform(-9, 9, (ROWS, 4)).astype(np.float32)}
    given = OnnxPolicy(adapt(source.model, source.mapping, spaces, "test")).distribution(observations)
    expected, logits, _ = source.original.act(observations, {})
    assert not isinstance(spaces.action, DictSpace)
    assert excused(given.actions, expected, known_logits(logits, expected, spaces), spaces.action).all()
    assert len(np.unique(expected, axis=0)) > 1


def test_a_program(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 5))
    program = torch.export.export(network, (torch.zeros(2, 4),), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, tmp_path / "program.pt2")
    sources, _ = open_sources(tmp_path / "program.pt2", interface(FIVE))
    assert_equal_actions(sources["shared"], FIVE)


def test_a_directory_has_a_file_for_each_policy(tmp_path: Path) -> None:
    """With spaces of their own."""
    two = Interface(
        agents={"a": interface(FIVE).agents["agent"], "b": interface(STEERED).agents["agent"]},
        policies={"a": "chooser", "b": "driver"},
        sides={"a": ("a",), "b": ("b",)},
    )
    for policy, outputs in (("chooser", 5), ("driver", 4)):
        if policy == "driver":
            with pytest.raises(ConfigError, match=r"no file driver\.onnx or driver\.pt2"):
                open_sources(tmp_path, two)
        network = nn.Linear(4, outputs)
        program = torch.export.export(network, (torch.zeros(2, 4),), dynamic_shapes=({0: torch.export.Dim("batch")},))
        torch.export.save(program, tmp_path / f"{policy}.pt2")
    sources, _ = open_sources(tmp_path, two)
    assert_equal_actions(sources["chooser"], FIVE)
    assert_equal_actions(sources["driver"], STEERED)


def test_a_program_with_a_fixed_batch_size_is_refused(tmp_path: Path) -> None:
    program = torch.export.export(nn.Linear(4, 5), (torch.zeros(2, 4),))
    torch.export.save(program, tmp_path / "program.pt2")
    with pytest.raises(EnvironmentMismatch, match="fixed batch size of 2"):
        open_sources(tmp_path / "program.pt2", interface(FIVE))


@pytest.mark.parametrize("action", [FIVE, STEERED])
def test_a_module_of_rllib(tmp_path: Path, action: gymnasium.Space[Any]) -> None:
    torch.manual_seed(0)
    module = DefaultPPOTorchRLModule(
        observation_space=SEEN, action_space=action, model_config=asdict(DefaultModelConfig()), inference_only=True
    )
    module.save_to_path(tmp_path / MODULES / "spreader")
    sources, _ = open_sources(tmp_path, interface(action), kind="rllib", modules={"shared": "spreader"})
    assert_equal_actions(sources["shared"], action)
    with pytest.raises(ConfigError, match="no module 'shared'; known: spreader; use --policy"):
        open_sources(tmp_path, interface(action), kind="rllib")


def test_a_directory_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="learner_group/learner/rl_module is missing"):
        open_sources(tmp_path, interface(FIVE), kind="rllib")


class SpacesOnly(gymnasium.Env[Any, Any]):
    """An environment that only defines spaces."""

    def __init__(self, action: gymnasium.Space[Any]) -> None:
        self.observation_space, self.action_space = SEEN, action


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "action"),
    [("PPO", FIVE), ("A2C", FIVE), ("DQN", FIVE), ("PPO", STEERED), ("SAC", STEERED), ("TD3", STEERED)],
)
def test_a_file_of_stable_baselines(tmp_path: Path, algorithm: str, action: gymnasium.Space[Any]) -> None:
    library = pytest.importorskip("stable_baselines3")
    torch.manual_seed(0)
    options = {"buffer_size": 10} if algorithm in ("DQN", "SAC", "TD3") else {}
    getattr(library, algorithm)("MlpPolicy", SpacesOnly(action), **options).save(tmp_path / "model.zip")
    sources, _ = open_sources(tmp_path / "model.zip", interface(action), kind="sb3")
    assert_equal_actions(sources["shared"], action)


def test_other_files_are_not_of_stable_baselines(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    (tmp_path / "model.zip").write_bytes(b"text")
    with pytest.raises(ConfigError, match=r"model.zip: not a file of Stable-Baselines3"):
        open_sources(tmp_path / "model.zip", interface(FIVE), kind="sb3")
