"""Models that other programs made, to be imported, each with its greedy actions as its own program computes them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Act = Callable[[Mapping[str, NDArray]], NDArray]
"""Observations by name, (k, …) → greedy actions (k,)"""


@dataclass(frozen=True, slots=True)
class ForeignModel:
    """A model to import.

    Attributes:
        name: Who made it.
        league: Bundled configuration of its league.
        path: File or directory to import.
        act: The model in its own program.
        options: Further arguments of `open_sources`.
    """

    name: str
    league: str
    path: Path
    act: Act
    options: dict[str, Any] = field(default_factory=dict)


class BoardNetwork(nn.Module):
    """Connect four with the planes first: float planes (k, 2, 6, 7) → logits of the columns and a value."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Conv2d(2, 16, 3, padding=1), nn.ReLU(), nn.Flatten(), nn.Linear(16 * 42, 64))
        self.policy_head, self.value_head = nn.Linear(64, 7), nn.Linear(64, 1)

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        features = torch.relu(self.body(planes))
        return self.policy_head(features), torch.tanh(self.value_head(features))


class LastPlanesNetwork(BoardNetwork):
    """The same for boards (k, 6, 7, 2)."""

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        return super().forward(planes.permute(0, 3, 1, 2))


MAPPING = """\
inputs:
  planes: {name: observation, transpose: [2, 0, 1]}
output: policy_head
kind: logits
"""


def mapped_graph(directory: Path) -> ForeignModel:
    """An ONNX file with other axes and names, and a mapping file."""
    path, mapping = directory / "mapped.onnx", directory / "names.yaml"
    mapping.write_text(MAPPING)
    _export(BoardNetwork(), (2, 6, 7), path)
    act = _by_runtime(path, (0, 3, 1, 2))
    return ForeignModel("ONNX, mapping file", "connect_four", path, act, {"mapping": mapping})


def matched_graph(directory: Path) -> ForeignModel:
    """An ONNX file with other names and types, whose tensors are matched by shape."""
    path = directory / "matched.onnx"
    _export(LastPlanesNetwork(), (6, 7, 2), path)
    return ForeignModel("ONNX, matched by shape", "connect_four", path, _by_runtime(path, (0, 1, 2, 3)))


def _export(network: nn.Module, shape: tuple[int, ...], path: Path) -> None:
    torch.manual_seed(0)
    program = torch.onnx.export(
        network.eval(),
        (torch.zeros((2, *shape)),),
        dynamo=True,
        input_names=["planes"],
        output_names=["policy_head", "value_head"],
        dynamic_shapes=({0: torch.export.Dim("n")},),
        verbose=False,
    )
    assert program is not None
    program.save(str(path), external_data=False)


def _by_runtime(path: Path, axes: tuple[int, ...]) -> Act:
    session = onnxruntime.InferenceSession(str(path))

    def act(observations: Mapping[str, NDArray]) -> NDArray:
        planes = observations["observation"].astype(np.float32).transpose(axes)
        (logits,) = session.run(["policy_head"], {"planes": planes})
        return np.where(observations["action_mask"] == 1, logits, -np.inf).argmax(axis=1)

    return act


def rllib_checkpoint(directory: Path) -> ForeignModel:
    """A checkpoint of RLlib's PPO after two iterations of simple_spread, with one module for all agents. Requires Ray
    to be running."""
    from mpe2 import simple_spread_v3
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.columns import Columns
    from ray.rllib.core.rl_module.rl_module import RLModule
    from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
    from ray.tune.registry import register_env

    path = directory / "rllib"
    register_env("spread", lambda _: ParallelPettingZooEnv(simple_spread_v3.parallel_env()))
    config = (
        PPOConfig()
        .environment("spread")
        .env_runners(num_env_runners=0)
        .multi_agent(policies={"spreader"}, policy_mapping_fn=lambda *_, **__: "spreader")
        .training(train_batch_size_per_learner=500, minibatch_size=250, num_epochs=2)
        .debugging(seed=0)
    )
    algorithm = config.build_algo()
    try:
        for _ in range(2):
            algorithm.train()
        algorithm.save_to_path(str(path))
    finally:
        algorithm.stop()
    module: Any = RLModule.from_checkpoint(path / "learner_group" / "learner" / "rl_module" / "spreader")

    def act(observations: Mapping[str, NDArray]) -> NDArray:
        with torch.no_grad():
            answer = module.forward_inference({Columns.OBS: torch.from_numpy(observations["observation"])})
        return answer[Columns.ACTION_DIST_INPUTS].argmax(dim=1).numpy()

    options = {"kind": "rllib", "modules": {"shared": "spreader"}, "trust": True}
    return ForeignModel("RLlib PPO", "simple_spread", path, act, options)


def stable_baselines_file(directory: Path) -> ForeignModel:
    """A file of Stable-Baselines3's PPO after 2,048 steps of simple_spread, by SuperSuit's vectorised environments."""
    import supersuit
    from mpe2 import simple_spread_v3
    from stable_baselines3 import PPO

    path = directory / "sb3.zip"
    agents = supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env())
    environment = supersuit.concat_vec_envs_v1(agents, 1, num_cpus=1, base_class="stable_baselines3")
    torch.manual_seed(0)  # PPO's own `seed` needs environments that SuperSuit does not provide
    model = PPO("MlpPolicy", environment, n_steps=512, batch_size=256, n_epochs=2, device="cpu")
    model.learn(2048)
    model.save(path)
    loaded = PPO.load(path, device="cpu")

    def act(observations: Mapping[str, NDArray]) -> NDArray:
        actions, _ = loaded.predict(observations["observation"], deterministic=True)
        return actions

    return ForeignModel("Stable-Baselines3 PPO", "simple_spread", path, act, {"kind": "sb3", "trust": True})
