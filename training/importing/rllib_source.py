"""Import of a checkpoint of RLlib's new API stack: the RLModule of one policy."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from ray.rllib.core import COMPONENT_LEARNER, COMPONENT_LEARNER_GROUP, COMPONENT_RL_MODULE
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.rl_module import RLModule
from torch import Tensor, nn

from league.errors import ConfigError, EnvironmentMismatch, one_line
from league.interface import AgentInterface
from league.spaces import ACTION_MASK, OBSERVATION, Box
from training.importing.graph_mapping import GraphMapping, InputMapping, Kind
from training.importing.source import Source, checked
from training.importing.torch_source import Examples, ModuleOriginal, converted

OUTPUT = "action_dist_inputs"


class InferenceGraph(nn.Module):
    """A module's distribution inputs, or its finished action if it has none, for one observation or one with a mask."""

    def __init__(self, module: Any, key: str | None) -> None:
        super().__init__()
        self.module, self._key = module, key

    def forward(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        observed = observation if self._key is None else {self._key: observation, ACTION_MASK: action_mask}
        answer = self.module.forward_inference({Columns.OBS: observed})
        return answer[Columns.ACTION_DIST_INPUTS] if Columns.ACTION_DIST_INPUTS in answer else answer[Columns.ACTIONS]


def rllib_source(path: Path, module_id: str, spaces: AgentInterface, origin: dict[str, Any]) -> Source:
    """Read a module from the checkpoint of an Algorithm. This unpickles files of the checkpoint.

    Args:
        path: Directory of the checkpoint.
        module_id: Id of the module in it.
        spaces: Spaces of the policy.
        origin: Recorded in the manifest.

    Raises:
        ConfigError: The directory is not a checkpoint, or does not contain the module.
        EnvironmentMismatch: The module does not fit the spaces.
    """
    modules = path / COMPONENT_LEARNER_GROUP / COMPONENT_LEARNER / COMPONENT_RL_MODULE
    if not modules.is_dir():
        raise ConfigError(f"{path}: not a checkpoint of RLlib's new API stack: {modules.relative_to(path)} is missing")
    if not (modules / module_id).is_dir():
        module_names = ", ".join(sorted(directory.name for directory in modules.iterdir() if directory.is_dir()))
        raise ConfigError(f"{path}: there is no module {module_id!r}; known: {module_names}; use --policy NAME=MODULE")
    try:
        # RLlib takes a relative path for a URI.
        module = RLModule.from_checkpoint((modules / module_id).resolve())
    except Exception as error:
        raise ConfigError(f"{modules / module_id}: the module cannot be restored: {one_line(error)}") from error
    where = f"{path}, module {module_id}"
    if module.is_stateful():
        raise EnvironmentMismatch(f"{where}: recurrent modules of RLlib are not supported; export one to ONNX")
    key, observed = _observed(module.observation_space, where)
    examples: Examples = {OBSERVATION: (observed.shape, _dtype(observed.dtype))}
    inputs = {OBSERVATION: InputMapping(name=OBSERVATION)}
    if key is not None:
        mask = module.observation_space[ACTION_MASK]
        examples[ACTION_MASK] = (mask.shape, _dtype(mask.dtype))
        inputs[ACTION_MASK] = InputMapping(name=ACTION_MASK)
    graph = InferenceGraph(module, key).eval()
    zeros = {name: torch.zeros((2, *shape), dtype=dtype) for name, (shape, dtype) in examples.items()}
    batch = zeros[OBSERVATION] if key is None else {key: zeros[OBSERVATION], ACTION_MASK: zeros[ACTION_MASK]}
    answer = module.forward_inference({Columns.OBS: batch})
    finished = Columns.ACTION_DIST_INPUTS not in answer
    kind: Kind = "action" if finished else "gaussian" if isinstance(spaces.action, Box) else "logits"
    mapping = GraphMapping(inputs=inputs, output=OUTPUT, kind=kind)
    model = converted(graph, examples, OUTPUT, where)
    model = checked(model, mapping, spaces, where)
    return Source(model, mapping, ModuleOriginal(graph, examples, mapping, spaces), origin)


def _observed(space: gymnasium.Space[Any], where: str) -> tuple[str | None, gymnasium.spaces.Box]:
    """The key of the observation beside a mask, or None, and its space."""
    if isinstance(space, gymnasium.spaces.Box):
        return None, space
    if isinstance(space, gymnasium.spaces.Dict) and ACTION_MASK in space.spaces:
        parts = [(key, part) for key, part in space.spaces.items() if key != ACTION_MASK]
        if len(parts) == 1 and isinstance(parts[0][1], gymnasium.spaces.Box):
            return parts[0]
    raise EnvironmentMismatch(f"{where}: observations are {space}: expected Box, or Dict with a Box and an action_mask")


def _dtype(dtype: Any) -> torch.dtype:
    """RLlib passes float64 to modules as float32."""
    name = np.dtype(dtype).name
    return torch.float32 if name == "float64" else getattr(torch, name)
