"""Opens the source of an import by its kind."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from league.errors import ConfigError, InvalidInput
from league.interface import AgentInterface, Interface
from training.importing.source import Source, onnx_source

SourceKind = Literal["rllib", "sb3"]


def open_sources(
    path: Path,
    interface: Interface,
    *,
    kind: SourceKind | None = None,
    mapping: Path | None = None,
    modules: Mapping[str, str] | None = None,
) -> tuple[dict[str, Source], str]:
    """Open the models for all policies of a league.

    Args:
        path: A file for all policies, or a directory with one named after each policy. With RLlib, a checkpoint.
        interface: Interface of the league.
        kind: Format of `path` if it contains pickles; else its suffix decides.
        mapping: File with a GraphMapping, for ONNX files and programs.
        modules: With RLlib: policy id → module id, where they differ.

    Returns:
        Policy id → model, and a digest of the source's content.

    Raises:
        ConfigError: A file is missing, or its format is unknown.
        EnvironmentMismatch: A model does not fit the league.
    """
    if not path.exists():
        raise ConfigError(f"{path}: no such file or directory")
    if modules and kind != "rllib":
        raise InvalidInput("--policy: only checkpoints of RLlib contain several modules; it requires --rllib")
    if unknown := [policy for policy in modules or () if policy not in interface.policy_ids]:
        raise InvalidInput(f"--policy {unknown[0]}: expected one of {', '.join(interface.policy_ids)}")
    digest = _digest(path, mapping, modules)
    sources = {}
    for policy in interface.policy_ids:
        spaces = interface.of_policy(policy)
        origin: dict[str, Any] = {"format": kind or "", "file": path.name, "sha256": digest}
        if kind == "rllib":
            from training.importing.rllib_source import rllib_source

            module = (modules or {}).get(policy, policy)
            sources[policy] = rllib_source(path, module, spaces, origin | {"module": module})
        elif kind == "sb3":
            from training.importing.sb3_source import sb3_source

            sources[policy] = sb3_source(_file(path, policy, (".zip",)), spaces, origin)
        else:
            sources[policy] = _graph_or_program(_file(path, policy, (".onnx", ".pt2")), mapping, spaces, origin)
    return sources, digest


def _file(path: Path, policy: str, suffixes: Sequence[str]) -> Path:
    """Return the file of a policy: `path`, or the one named after the policy in the directory `path`."""
    if not path.is_dir():
        return path
    candidates = [path / f"{policy}{suffix}" for suffix in suffixes]
    for file in candidates:
        if file.exists():
            return file
    raise ConfigError(f"{path}: no file {' or '.join(file.name for file in candidates)}")


def _graph_or_program(file: Path, mapping: Path | None, spaces: AgentInterface, origin: dict[str, Any]) -> Source:
    if file.suffix == ".pt2":
        from training.importing.torch_source import torch_source

        return torch_source(file, mapping, spaces, origin | {"format": "torch.export"})
    if file.suffix == ".onnx":
        return onnx_source(file, mapping, spaces, origin | {"format": "onnx"})
    raise ConfigError(f"{file}: expected a directory, .onnx or .pt2, or the option --rllib or --sb3")


def _digest(path: Path, *choices: object) -> str:
    """Digest of a file or of all files of a directory, and of what else decides how they are imported."""
    found = hashlib.sha256()
    files = sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]
    mapping = [each for each in (choices[0],) if isinstance(each, Path) and each.exists()]
    for file in [*files, *mapping, *([beside] if (beside := path.with_suffix(".yaml")).exists() else [])]:
        found.update(file.name.encode())
        found.update(hashlib.sha256(file.read_bytes()).digest())
    found.update(repr(choices[1:]).encode())
    return found.hexdigest()
