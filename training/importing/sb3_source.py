"""Import of a file of Stable-Baselines3 or sb3-contrib: PPO, MaskablePPO, A2C and DQN with one Box observation, and
TD3, DDPG and SAC actors.
"""

import inspect
import pickle
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from league.errors import ConfigError, EnvironmentMismatch, InvalidInput, one_line
from league.interface import AgentInterface
from league.spaces import ACTION_MASK, OBSERVATION, Box, DictSpace, Discrete, inputs
from training.importing.graph_mapping import GraphMapping, InputMapping, Kind
from training.importing.source import Source, State, checked
from training.importing.torch_source import Examples, converted

OUTPUT = "output"
FORMATS = ("PPO", "A2C", "DQN", "TD3", "DDPG", "SAC")
MASKABLE = "MaskablePPO"
"""Of sb3-contrib."""


class Logits(nn.Module):
    """Logits of PPO's and A2C's policies; means and log standard deviations for continuous actions."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor) -> Tensor:
        features = self.policy.extract_features(observation, self.policy.pi_features_extractor)
        means = self.policy.action_net(self.policy.mlp_extractor.forward_actor(features))
        if not hasattr(self.policy, "log_std"):
            return means
        return torch.cat([means, self.policy.log_std.expand_as(means)], dim=1)


class Values(nn.Module):
    """Action values of DQN."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor) -> Tensor:
        return self.policy.q_net(observation)


class Chosen(nn.Module):
    """Deterministic actions of TD3, DDPG and SAC in the units of the action space."""

    low: Tensor
    high: Tensor

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.actor = policy.actor
        self.register_buffer("low", torch.as_tensor(policy.action_space.low))
        self.register_buffer("high", torch.as_tensor(policy.action_space.high))

    def forward(self, observation: Tensor) -> Tensor:
        if hasattr(self.actor, "get_action_dist_params"):  # SAC's Gaussian before it is squashed
            within = torch.tanh(self.actor.get_action_dist_params(observation)[0])
        else:
            within = self.actor(observation)
        return self.low + 0.5 * (within + 1.0) * (self.high - self.low)


class Normalized(nn.Module):
    """A model behind VecNormalize: (x - mean) / √(variance + ε), clipped, of float64.

    Args:
        model: The model.
        statistics: What VecNormalize has saved.
        order: Order of the axes in which the model receives observations; empty for that of the statistics.
        shape: Shape in which it receives them.
    """

    mean: Tensor
    deviation: Tensor

    def __init__(self, model: nn.Module, statistics: Any, order: tuple[int, ...], shape: tuple[int, ...]) -> None:
        super().__init__()
        self.model, self.clip = model, float(statistics.clip_obs)
        deviation = np.sqrt(statistics.obs_rms.var + statistics.epsilon)
        for name, array in (("mean", statistics.obs_rms.mean), ("deviation", deviation)):
            ordered = np.transpose(array, order) if order else array
            self.register_buffer(name, torch.from_numpy(np.asarray(ordered, np.float64).reshape(shape).copy()))

    def forward(self, observation: Tensor) -> Tensor:
        return self.model(((observation - self.mean) / self.deviation).clamp(-self.clip, self.clip).float())


class PredictOriginal:
    """The model as Stable-Baselines3 runs it: `predict(…, deterministic=True)`, after VecNormalize if it has any."""

    def __init__(
        self, model: Any, statistics: Any, graph: nn.Module, mapping: GraphMapping, spaces: AgentInterface
    ) -> None:
        self._model, self._graph, self._kind, self._spaces = model, graph, mapping.kind, spaces
        self._statistics = statistics
        self._transpose = mapping.inputs[OBSERVATION].transpose
        self._takes_masks = "action_masks" in inspect.signature(model.predict).parameters

    def initial_state(self, rows: int) -> State:  # noqa: ARG002
        """Return no state."""
        return {}

    def act(self, observations: Mapping[str, NDArray], state: State) -> tuple[NDArray, NDArray | None, State]:
        """Call `predict`, with the mask if it takes one. Otherwise the best legal logit decides."""
        observation, logits = self._fitted(observations[OBSERVATION]), None
        if self._kind != "gaussian" and self._kind != "action":
            dtype = np.float32 if self._statistics is None else np.float64
            with torch.no_grad():
                logits = self._graph(torch.from_numpy(observation.astype(dtype))).numpy()
        action, mask = self._spaces.action, observations.get(ACTION_MASK)
        if mask is not None and logits is not None and not self._takes_masks:
            assert isinstance(action, Discrete)
            return np.where(mask != 0, logits, -np.inf).argmax(axis=1) + action.start, logits, state
        masks = {} if mask is None or not self._takes_masks else {"action_masks": mask != 0}
        if self._statistics is not None:
            shaped = observations[OBSERVATION].reshape(-1, *self._statistics.obs_rms.mean.shape)
            observation = self._fitted(self._statistics.normalize_obs(shaped))
        observation = observation.astype(self._model.observation_space.dtype)
        actions, _ = self._model.predict(observation, deterministic=True, **masks)
        assert not isinstance(action, DictSpace)
        if isinstance(action, Discrete) and self._model.action_space.start != action.start:
            actions = actions - self._model.action_space.start + action.start
        return actions.reshape(-1, *action.shape).astype(action.dtype), logits, state

    def _fitted(self, observation: NDArray) -> NDArray:
        """Return observations in the order and shape that the model expects."""
        if self._transpose:
            observation = observation.transpose(0, *(axis + 1 for axis in self._transpose))
        return np.ascontiguousarray(observation).reshape(-1, *self._model.observation_space.shape)


def sb3_source(path: Path, vec_normalize: Path | None, spaces: AgentInterface, origin: dict[str, Any]) -> Source:
    """Read a file that `model.save` wrote. This unpickles parts of the files.

    Args:
        path: The file.
        vec_normalize: File that `VecNormalize.save` wrote, which becomes a part of the graph.
        spaces: Spaces of the policy.
        origin: Recorded in the manifest.

    Raises:
        ConfigError: Stable-Baselines3 is not installed, or the file is not of a supported algorithm.
        EnvironmentMismatch: The model or its statistics do not fit the spaces.
        InvalidInput: The statistics of VecNormalize beside the model are not mentioned.
    """
    model = _load(path)
    policy = model.policy.to("cpu").eval()
    policy.set_training_mode(False)
    observed = inputs(spaces.observation)
    space = model.observation_space
    if OBSERVATION not in observed or type(space).__name__ != "Box":
        raise EnvironmentMismatch(f"{path}: observations are {space}: expected one Box, as in the league")
    graph: nn.Module
    kind: Kind
    if hasattr(policy, "q_net"):
        graph, kind = Values(policy), "values"
    elif hasattr(policy, "actor"):
        graph, kind = Chosen(policy), "action"
    else:
        graph, kind = Logits(policy), "gaussian" if isinstance(spaces.action, Box) else "logits"
    leaf = observed[OBSERVATION]
    transpose = _transpose(leaf.shape, space.shape)
    statistics = _statistics(path, vec_normalize)
    if statistics is not None:
        shape = getattr(getattr(statistics.obs_rms, "mean", None), "shape", None)
        if shape != leaf.shape and (shape != space.shape or transpose):
            sizes = "a Dict" if shape is None else list(shape)
            raise EnvironmentMismatch(
                f"{vec_normalize}: the statistics are of observations {sizes}: expected {list(leaf.shape)}, as in the"
                " league"
            )
        graph = Normalized(graph, statistics, transpose if shape == leaf.shape else (), space.shape)
    mapping = GraphMapping(
        inputs={OBSERVATION: InputMapping(name=OBSERVATION, transpose=transpose)},
        output=OUTPUT,
        kind=kind,
        units="environment" if kind == "gaussian" else "normalized",
    )
    examples: Examples = {OBSERVATION: (space.shape, torch.float32 if statistics is None else torch.float64)}
    onnx_model = converted(graph.eval(), examples, OUTPUT, str(path))
    onnx_model = checked(onnx_model, mapping, spaces, str(path))
    return Source(onnx_model, mapping, PredictOriginal(model, statistics, graph, mapping, spaces), origin)


def _transpose(shape: tuple[int, ...], expected: tuple[int, ...]) -> tuple[int, ...]:
    """Return the order of axes in which a model that was trained on images (height, width, channels) expects them.

    Stable-Baselines3 transposes such images for its policies (`VecTransposeImage`).
    """
    channels_first = (2, 0, 1)
    is_image = len(shape) == 3 and shape != expected
    return channels_first if is_image and tuple(shape[axis] for axis in channels_first) == expected else ()


def _statistics(path: Path, vec_normalize: Path | None) -> Any:
    """Return the VecNormalize of a model; None without one, or if it leaves observations as they are."""
    if vec_normalize is None:
        files = sorted(path.parent.glob("*.pkl"))
        if beside := [file for file in files if "vecnormalize" in file.name.lower().replace("_", "")]:
            raise InvalidInput(
                f"{path}: {beside[0].name} is beside it: add --vec-normalize {beside[0]}, or move that file if the"
                " model was trained without it"
            )
        return None
    from stable_baselines3.common.vec_env import VecNormalize

    try:
        with vec_normalize.open("rb") as file:
            statistics = pickle.load(file)
    except OSError as error:
        raise ConfigError(f"--vec-normalize {vec_normalize}: {error.strerror or error}") from error
    except Exception as error:  # a pickle may raise anything
        raise ConfigError(f"--vec-normalize {vec_normalize}: not a pickle: {one_line(error)}") from error
    if not isinstance(statistics, VecNormalize):
        kind = type(statistics).__name__
        raise ConfigError(f"--vec-normalize {vec_normalize}: a {kind}, expected what VecNormalize.save writes")
    return statistics if statistics.norm_obs else None


def _load(path: Path) -> Any:
    try:
        import stable_baselines3
        from stable_baselines3.common.save_util import load_from_zip_file
    except ImportError as error:
        raise ConfigError(f"--sb3 requires Stable-Baselines3: pip install 'policy-league[sb3]' ({error})") from error
    algorithm_classes = {name: getattr(stable_baselines3, name) for name in FORMATS}
    with suppress(ImportError):
        import sb3_contrib

        algorithm_classes[MASKABLE] = sb3_contrib.MaskablePPO
    try:
        data, _, _ = load_from_zip_file(path, device="cpu", load_data=True)
    except Exception as error:
        raise ConfigError(f"{path}: not a file of Stable-Baselines3: {one_line(error)}") from error
    policy_class = str(getattr((data or {}).get("policy_class"), "__module__", ""))
    algorithms = [name for name in FORMATS if f".{name.lower()}." in policy_class]
    candidates = algorithms or (["PPO", "A2C"] if "common.policies" in policy_class else [])
    if ".maskable." in policy_class:
        candidates = [MASKABLE]
    for name in candidates:
        try:
            return algorithm_classes[name].load(path, device="cpu")
        except Exception as error:
            problem = one_line(error)
    raise ConfigError(
        f"{path}: cannot be loaded: {problem if candidates else f'policy of {policy_class or None}'}; "
        f"supported: {', '.join(FORMATS)}, and {MASKABLE} of sb3-contrib, which must be installed for it"
    )
