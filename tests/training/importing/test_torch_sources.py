"""Models of PyTorch: `torch.export` programs, modules of RLlib, and files of Stable-Baselines3."""

import pickle
import zipfile
from collections.abc import Iterator
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

from league.errors import ConfigError, EnvironmentMismatch, InvalidInput, LeagueError
from league.interface import AgentInterface, Interface
from league.policies.onnx import OnnxPolicy
from league.policies.probes import excused
from league.spaces import DictSpace
from league.spaces.conversion import from_gymnasium
from training.importing.adapted_graph import adapt
from training.importing.open_source import SourceKind, open_sources
from training.importing.source import Source, known_logits

ROWS = 300
SEEN = gymnasium.spaces.Box(-9.0, 9.0, (4,), np.float32)
FIVE = gymnasium.spaces.Discrete(5)
MASK = gymnasium.spaces.Box(0, 1, (5,), np.int8)
STEERED = gymnasium.spaces.Box(np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32))
MODULES = Path("learner_group", "learner", "rl_module")


def interface(action: gymnasium.Space[Any]) -> Interface:
    spaces = AgentInterface(observation=from_gymnasium(SEEN), action=from_gymnasium(action))
    return Interface(agents={"agent": spaces}, policies={"agent": "shared"}, sides={"agent": ("agent",)})


def assert_equal_actions(source: Source, action: gymnasium.Space[Any]) -> None:
    spaces = interface(action).of_policy("shared")
    rng = np.random.default_rng(0)
    observations = {"observation": rng.uniform(-9, 9, (ROWS, 4)).astype(np.float32)}
    actions = OnnxPolicy(adapt(source.model, source.mapping, spaces, "test")).distribution(observations)
    expected, logits, _ = source.original.act(observations, {})
    assert not isinstance(spaces.action, DictSpace)
    assert excused(actions.actions, expected, known_logits(logits, expected, spaces), spaces.action).all()
    assert len(np.unique(expected, axis=0)) > 1


def save_program(path: Path, network: nn.Module | None = None) -> None:
    torch.manual_seed(0)
    network = network or nn.Sequential(nn.Linear(4, 16), nn.Tanh(), nn.Linear(16, 5))
    program = torch.export.export(network, (torch.zeros(2, 4),), dynamic_shapes=({0: torch.export.Dim("batch")},))
    torch.export.save(program, path)


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
                open_sources(tmp_path, two, trust=True)
        save_program(tmp_path / f"{policy}.pt2", nn.Linear(4, outputs))
    sources, _ = open_sources(tmp_path, two, trust=True)
    assert_equal_actions(sources["chooser"], FIVE)
    assert_equal_actions(sources["driver"], STEERED)


def save_module(checkpoint: Path, name: str = "shared", action: gymnasium.Space[Any] = FIVE) -> None:
    torch.manual_seed(0)
    config = asdict(DefaultModelConfig(fcnet_hiddens=[8]))
    module = DefaultPPOTorchRLModule(
        observation_space=SEEN, action_space=action, model_config=config, inference_only=True
    )
    module.save_to_path(checkpoint / MODULES / name)


def attack(path: Path, marker: Path) -> None:
    """Write a program that creates `marker` when it is read: torch evaluates the sizes of its tensors by SymPy."""
    save_program(path)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    code = f"__import__('pathlib').Path('{marker}').touch() or Symbol("
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content.replace(b"Symbol(", code.encode()))


def test_code_in_a_program_runs_only_if_it_is_trusted(tmp_path: Path) -> None:
    marker, path = tmp_path / "marker", tmp_path / "models" / "shared.pt2"
    path.parent.mkdir()
    attack(path, marker)
    for source in (path, path.parent):
        with pytest.raises(
            InvalidInput, match=r"shared.pt2: reading a torch.export program runs code from it: add --t"
        ):
            open_sources(source, interface(FIVE))
    path.with_suffix(".onnx").write_bytes(path.read_bytes())
    for source in (path.with_suffix(".onnx"), path.parent):
        with pytest.raises(ConfigError, match=r"shared.onnx: not an ONNX model"):
            open_sources(source, interface(FIVE))
    assert not marker.exists()
    sources, _ = open_sources(path, interface(FIVE), trust=True)
    assert marker.exists()
    assert_equal_actions(sources["shared"], FIVE)


@pytest.mark.parametrize("kind", ["rllib", "sb3"])
def test_pickles_are_not_read_without_trust_and_need_no_mapping(tmp_path: Path, kind: SourceKind) -> None:
    (tmp_path / "shared.zip").write_bytes(b"anything")
    with pytest.raises(InvalidInput, match="runs code from it: add --trust"):
        open_sources(tmp_path, interface(FIVE), kind=kind)
    with pytest.raises(InvalidInput, match=rf"--mapping names.yaml: --{kind} determines the inputs and outputs"):
        open_sources(tmp_path, interface(FIVE), kind=kind, mapping=Path("names.yaml"), trust=True)


def damages(content: bytes) -> Iterator[bytes]:
    """Variants of a file: cut off, with zeros or noise in it, and with bytes in the wrong order."""
    rng = np.random.default_rng(0)
    for position in np.linspace(0, len(content) - 1, 5).astype(int):
        yield content[:position]
        yield content[:position] + bytes(16) + content[position + 16 :]
        yield content[:position] + rng.bytes(16) + content[position + 16 :]
        yield content[position:] + content[:position]


def refusal(source: Path, **options: Any) -> str | None:
    """The message for a damaged file; None if it can be read. Another exception would be a traceback."""
    try:
        open_sources(source, interface(FIVE), **options)
    except LeagueError as error:
        return str(error)
    return None


def test_a_damaged_program_is_named_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "program.pt2"
    save_program(path)
    messages = []
    for content in list(damages(path.read_bytes())):
        path.write_bytes(content)
        messages.append(refusal(path, trust=True))
    refusals = [message for message in messages if message is not None]
    assert len(refusals) > 6
    assert all(message.startswith(str(path)) and "\n" not in message for message in refusals)


def test_a_damaged_checkpoint_is_named_in_one_line(tmp_path: Path) -> None:
    save_module(tmp_path)
    messages = []
    for file in sorted((tmp_path / MODULES / "shared").iterdir()):
        content = file.read_bytes()
        for damaged in (content[: len(content) // 2], b"", content[::-1]):
            file.write_bytes(damaged)
            messages.append(refusal(tmp_path, kind="rllib", trust=True))
        file.write_bytes(content)
    refusals = [message for message in messages if message is not None]
    assert len(refusals) > 4
    assert all(str(tmp_path) in message and "\n" not in message for message in refusals)


@pytest.mark.parametrize("action", [FIVE, STEERED])
def test_a_module_of_rllib(tmp_path: Path, action: gymnasium.Space[Any]) -> None:
    save_module(tmp_path, "spreader", action)
    sources, _ = open_sources(tmp_path, interface(action), kind="rllib", modules={"shared": "spreader"}, trust=True)
    assert_equal_actions(sources["shared"], action)
    with pytest.raises(ConfigError, match="no module 'shared'; known: spreader; use --policy"):
        open_sources(tmp_path, interface(action), kind="rllib", trust=True)


def test_a_checkpoint_of_rllib_with_a_relative_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_module(tmp_path / "checkpoint")
    monkeypatch.chdir(tmp_path)
    sources, _ = open_sources(Path("checkpoint"), interface(FIVE), kind="rllib", trust=True)
    assert_equal_actions(sources["shared"], FIVE)


def test_a_directory_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="learner_group/learner/rl_module is missing"):
        open_sources(tmp_path, interface(FIVE), kind="rllib", trust=True)


class SpacesOnly(gymnasium.Env[Any, Any]):
    """An environment that only defines spaces."""

    def __init__(self, action: gymnasium.Space[Any], observation: gymnasium.Space[Any] = SEEN) -> None:
        self.observation_space, self.action_space = observation, action


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
    sources, _ = open_sources(tmp_path / "model.zip", interface(action), kind="sb3", trust=True)
    assert_equal_actions(sources["shared"], action)


def saved_statistics(library: Any, file: Path, observation: gymnasium.Space[Any], **options: Any) -> Any:
    """A VecNormalize with means and variances far from 0 and 1, which `file` contains."""
    environments = library.common.vec_env.DummyVecEnv([lambda: SpacesOnly(FIVE, observation)])
    statistics = library.common.vec_env.VecNormalize(environments, **options)
    if isinstance(observation, gymnasium.spaces.Box) and statistics.norm_obs:
        rng = np.random.default_rng(1)
        statistics.obs_rms.mean = rng.uniform(-900, 900, observation.shape)
        statistics.obs_rms.var = rng.uniform(0.01, 900, observation.shape)
    statistics.save(file)
    return statistics


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "action"), [("PPO", FIVE), ("DQN", FIVE), ("PPO", STEERED), ("SAC", STEERED)])
def test_statistics_of_vec_normalize_are_a_part_of_the_graph(
    tmp_path: Path, algorithm: str, action: gymnasium.Space[Any]
) -> None:
    library = pytest.importorskip("stable_baselines3")
    torch.manual_seed(0)
    options = {"buffer_size": 10} if algorithm in ("DQN", "SAC") else {}
    model = getattr(library, algorithm)("MlpPolicy", SpacesOnly(action), **options)
    model.save(tmp_path / "model.zip")
    file = tmp_path / "my_VecNormalize_5_steps.pkl"
    statistics = saved_statistics(library, file, SEEN, clip_obs=2.0)
    with pytest.raises(InvalidInput, match=f"add --vec-normalize {file}, or move that file"):
        open_sources(tmp_path / "model.zip", interface(action), kind="sb3", trust=True)
    sources, digest = open_sources(
        tmp_path / "model.zip", interface(action), kind="sb3", vec_normalize=file, trust=True
    )
    source, spaces = sources["shared"], interface(action).of_policy("shared")
    assert source.origin["vec_normalize"] == file.name
    near = statistics.obs_rms.mean + np.random.default_rng(0).normal(0, 30, (ROWS, 4))
    observations = {"observation": near.astype(np.float32)}
    answer = OnnxPolicy(adapt(source.model, source.mapping, spaces, "test")).distribution(observations)
    expected = model.predict(statistics.normalize_obs(observations["observation"]), deterministic=True)[0]
    original, logits, _ = source.original.act(observations, {})
    assert answer.dist_inputs is not None
    assert excused(answer.actions, expected, known_logits(logits, expected, spaces), spaces.action).all()
    np.testing.assert_array_equal(original, expected)
    statistics.obs_rms.mean += 1
    statistics.save(file)
    other = open_sources(tmp_path / "model.zip", interface(action), kind="sb3", vec_normalize=file, trust=True)[1]
    assert other != digest


@pytest.mark.slow
def test_other_statistics_are_refused(tmp_path: Path) -> None:
    library = pytest.importorskip("stable_baselines3")
    library.PPO("MlpPolicy", SpacesOnly(FIVE)).save(tmp_path / "model.zip")

    def opened(file: Path) -> Source:
        sources, _ = open_sources(tmp_path / "model.zip", interface(FIVE), kind="sb3", vec_normalize=file, trust=True)
        return sources["shared"]

    file = tmp_path / "vecnormalize.pkl"
    with pytest.raises(ConfigError, match=r"--vec-normalize .*vecnormalize.pkl: No such file"):
        opened(file)
    file.write_bytes(b"text")
    with pytest.raises(ConfigError, match="not a pickle"):
        opened(file)
    file.write_bytes(pickle.dumps([]))
    with pytest.raises(ConfigError, match=r"a list, expected what VecNormalize\.save writes"):
        opened(file)
    saved_statistics(library, file, gymnasium.spaces.Box(-1, 1, (8,)))
    with pytest.raises(EnvironmentMismatch, match=r"statistics are of observations \[8\]: expected \[4\]"):
        opened(file)
    saved_statistics(library, file, gymnasium.spaces.Dict({"a": SEEN}))
    with pytest.raises(EnvironmentMismatch, match=r"statistics are of observations a Dict"):
        opened(file)
    saved_statistics(library, file, SEEN, norm_obs=False)
    assert_equal_actions(opened(file), FIVE)


@pytest.mark.slow
def test_normalized_images_keep_the_order_of_their_axes(tmp_path: Path) -> None:
    """VecNormalize is applied before Stable-Baselines3 transposes images."""
    library = pytest.importorskip("stable_baselines3")
    torch.manual_seed(0)
    pixels, file = gymnasium.spaces.Box(0, 255, (40, 36, 3), np.uint8), tmp_path / "vecnormalize.pkl"
    statistics = saved_statistics(library, file, pixels)
    first = SpacesOnly(FIVE, gymnasium.spaces.Box(-10, 10, (3, 40, 36), np.float32))
    model = library.PPO("CnnPolicy", first, policy_kwargs={"normalize_images": False})
    model.save(tmp_path / "model.zip")
    spaces = AgentInterface(observation=from_gymnasium(pixels), action=from_gymnasium(FIVE))
    of_images = Interface(agents={"agent": spaces}, policies={"agent": "shared"}, sides={"agent": ("agent",)})
    sources, _ = open_sources(tmp_path / "model.zip", of_images, kind="sb3", vec_normalize=file, trust=True)
    source = sources["shared"]
    images = np.random.default_rng(0).integers(0, 256, (50, 40, 36, 3), dtype=np.uint8)
    answer = OnnxPolicy(adapt(source.model, source.mapping, spaces, "test")).distribution({"observation": images})
    normalized = statistics.normalize_obs(images).transpose(0, 3, 1, 2)
    expected = model.predict(normalized, deterministic=True)[0]
    original, logits, _ = source.original.act({"observation": images}, {})
    np.testing.assert_array_equal(original, expected)
    assert answer.dist_inputs is not None
    assert np.allclose(answer.dist_inputs, logits, atol=1e-3)


def test_statistics_are_of_stable_baselines(tmp_path: Path) -> None:
    (tmp_path / "model.onnx").touch()
    with pytest.raises(InvalidInput, match="--vec-normalize: only models of Stable-Baselines3"):
        open_sources(tmp_path / "model.onnx", interface(FIVE), vec_normalize=tmp_path / "vecnormalize.pkl")


@pytest.mark.slow
def test_a_maskable_policy_of_sb3_contrib(tmp_path: Path) -> None:
    library = pytest.importorskip("sb3_contrib")
    torch.manual_seed(0)
    model = library.MaskablePPO("MlpPolicy", SpacesOnly(FIVE))
    model.save(tmp_path / "model.zip")
    observation = DictSpace(spaces={"observation": from_gymnasium(SEEN), "action_mask": from_gymnasium(MASK)})
    spaces = AgentInterface(observation=observation, action=from_gymnasium(FIVE))
    masked = Interface(agents={"agent": spaces}, policies={"agent": "shared"}, sides={"agent": ("agent",)})
    sources, _ = open_sources(tmp_path / "model.zip", masked, kind="sb3", trust=True)
    source, rng = sources["shared"], np.random.default_rng(0)
    observations = {
        "observation": rng.uniform(-9, 9, (ROWS, 4)).astype(np.float32),
        "action_mask": np.eye(5, dtype=np.int8)[rng.integers(5, size=ROWS)]
        | rng.integers(2, size=(ROWS, 5), dtype=np.int8),
    }
    answer = OnnxPolicy(adapt(source.model, source.mapping, spaces, "test")).distribution(observations)
    masks = observations["action_mask"] != 0
    expected, _ = model.predict(observations["observation"], action_masks=masks, deterministic=True)
    assert np.array_equal(source.original.act(observations, {})[0], expected)
    assert (answer.actions == expected).mean() > 0.99, "but for equal logits"
    assert masks[np.arange(ROWS), answer.actions].all()


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(40, 36, 3), (3, 40, 36)])
@pytest.mark.parametrize("algorithm", ["PPO", "DQN"])
def test_an_image_policy_of_stable_baselines(tmp_path: Path, algorithm: str, shape: tuple[int, ...]) -> None:
    """Stable-Baselines3 transposes images to (channels, height, width), and scales them to [0, 1]."""
    library = pytest.importorskip("stable_baselines3")
    torch.manual_seed(0)
    pixels = gymnasium.spaces.Box(0, 255, shape, np.uint8)
    options = {"buffer_size": 10} if algorithm == "DQN" else {}
    model = getattr(library, algorithm)("CnnPolicy", SpacesOnly(FIVE, pixels), **options)
    model.save(tmp_path / "model.zip")
    spaces = AgentInterface(observation=from_gymnasium(pixels), action=from_gymnasium(FIVE))
    of_images = Interface(agents={"agent": spaces}, policies={"agent": "shared"}, sides={"agent": ("agent",)})
    sources, _ = open_sources(tmp_path / "model.zip", of_images, kind="sb3", trust=True)
    source = sources["shared"]
    images = np.random.default_rng(0).integers(0, 256, (ROWS, *shape), dtype=np.uint8)
    images[::2] //= 16
    answer = OnnxPolicy(adapt(source.model, source.mapping, spaces, "test")).distribution({"observation": images})
    assert answer.dist_inputs is not None
    expected, logits, _ = source.original.act({"observation": images}, {})
    assert np.array_equal(expected, model.predict(images, deterministic=True)[0])
    assert excused(answer.actions, expected, known_logits(logits, expected, spaces), spaces.action).all()
    assert np.allclose(answer.dist_inputs, logits, atol=1e-4)


def test_other_files_are_not_of_stable_baselines(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    (tmp_path / "model.zip").write_bytes(b"text")
    with pytest.raises(ConfigError, match=r"model.zip: not a file of Stable-Baselines3"):
        open_sources(tmp_path / "model.zip", interface(FIVE), kind="sb3", trust=True)
