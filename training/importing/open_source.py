"""Opens the source of an import by its kind."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from league.errors import ConfigError, InvalidInput, LeagueError, one_line
from league.interface import AgentInterface, Interface
from training.importing.git_lfs import require_content
from training.importing.source import Source, onnx_source

SourceKind = Literal["rllib", "sb3"]
SUFFIXES: dict[SourceKind | None, tuple[str, ...]] = {None: (".onnx", ".pt2"), "sb3": (".zip",), "rllib": ()}
"""Option → suffixes of the policies' files in a directory; a checkpoint is one directory for all policies."""
FORMATS = {".onnx": "onnx", ".pt2": "torch.export"}
NAMES = {
    "onnx": "an ONNX model",
    "torch.export": "a torch.export program",
    "sb3": "a file of Stable-Baselines3",
    "rllib": "a checkpoint of RLlib",
}


def open_sources(
    path: Path,
    interface: Interface,
    *,
    kind: SourceKind | None = None,
    mapping: Path | None = None,
    modules: Mapping[str, str] | None = None,
    vec_normalize: Path | None = None,
    trust: bool = False,
) -> tuple[dict[str, Source], str]:
    """Open the models for all policies of a league.

    Args:
        path: A file for all policies, or a directory with one named after each policy. With RLlib, a checkpoint.
        interface: Interface of the league.
        kind: Format of `path`; by default its suffix decides.
        mapping: File with a GraphMapping, for ONNX files and programs.
        modules: With RLlib: policy id → module id, where they differ.
        vec_normalize: With Stable-Baselines3: statistics of VecNormalize for all policies, or a directory with a file
            for each.
        trust: Whether code in `path` may run: reading any format except ONNX can run code.

    Returns:
        Policy id → model, and a digest of the source's content.

    Raises:
        ConfigError: A file is missing, its format is unknown, or it is a pointer of Git LFS.
        EnvironmentMismatch: A model does not fit the league.
        InvalidInput: A format that can run code is not trusted. Nothing of it was read.
    """
    if not path.exists():
        raise ConfigError(f"{path}: no such file or directory")
    if mapping is not None and kind is not None:
        raise InvalidInput(
            f"--mapping {mapping}: --{kind} determines the inputs and outputs of a model itself; remove --mapping, or"
            " export the model to ONNX"
        )
    if modules and kind != "rllib":
        raise InvalidInput("--policy: only checkpoints of RLlib contain several modules; it requires --rllib")
    if vec_normalize is not None and kind != "sb3":
        raise InvalidInput("--vec-normalize: only models of Stable-Baselines3 have its statistics; it requires --sb3")
    if unknown := [policy for policy in modules or () if policy not in interface.policy_ids]:
        raise InvalidInput(f"--policy {unknown[0]}: expected one of {', '.join(interface.policy_ids)}")
    files = {policy: _file(path, policy, SUFFIXES[kind]) for policy in interface.policy_ids}
    formats: dict[str, str] = {}
    for policy, file in files.items():
        if kind is None and file.suffix not in FORMATS:
            raise ConfigError(f"{file}: expected a directory, .onnx or .pt2, or the option --rllib or --sb3")
        formats[policy] = kind or FORMATS[file.suffix]
        if formats[policy] != "onnx" and not trust:
            name = NAMES[formats[policy]]
            raise InvalidInput(f"{file}: reading {name} runs code from it: add --trust if you trust its author")
    digest = _digest(path, [mapping, vec_normalize], modules)
    sources = {}
    for policy, file in files.items():
        origin: dict[str, Any] = {"format": formats[policy], "file": path.name, "sha256": digest}
        module = (modules or {}).get(policy, policy)
        try:
            statistics = None if vec_normalize is None else _file(vec_normalize, policy, (".pkl",))
            spaces = interface.of_policy(policy)
            sources[policy] = _read(file, formats[policy], module, mapping, statistics, spaces, origin)
        except LeagueError:
            raise
        except Exception as error:  # the libraries that read a damaged file raise many kinds
            name = NAMES[formats[policy]]
            raise ConfigError(f"{file}: {name} that is damaged: {one_line(error, with_type=True)[:300]}") from error
    return sources, digest


def _read(
    file: Path,
    file_format: str,
    module: str,
    mapping: Path | None,
    vec_normalize: Path | None,
    spaces: AgentInterface,
    origin: dict[str, Any],
) -> Source:
    if file_format == "rllib":
        from training.importing.rllib_source import rllib_source

        return rllib_source(file, module, spaces, origin | {"module": module})
    if file_format == "sb3":
        from training.importing.sb3_source import sb3_source

        if vec_normalize is not None:
            origin |= {"vec_normalize": vec_normalize.name}
        return sb3_source(file, vec_normalize, spaces, origin)
    if file_format == "torch.export":
        from training.importing.torch_source import torch_source

        return torch_source(file, mapping, spaces, origin)
    return onnx_source(file, mapping, spaces, origin)


def _file(path: Path, policy: str, suffixes: Sequence[str]) -> Path:
    """Return the file of a policy: `path`, or the one named after the policy in the directory `path`."""
    file = path
    if suffixes and path.is_dir():
        candidates = [path / f"{policy}{suffix}" for suffix in suffixes]
        existing = [candidate for candidate in candidates if candidate.exists()]
        if not existing:
            raise ConfigError(f"{path}: no file {' or '.join(candidate.name for candidate in candidates)}")
        file = existing[0]
    for part in file.rglob("*") if file.is_dir() else [file]:
        require_content(part)
    return file


def _digest(path: Path, others: Sequence[Path | None], modules: Mapping[str, str] | None) -> str:
    """Digest of a file or of all files of a directory, and of what else decides how they are imported."""
    digest = hashlib.sha256()
    for source in (path, *others, path.with_suffix(".yaml")):
        if source is not None and source.exists():
            for file in sorted(file for file in source.rglob("*") if file.is_file()) if source.is_dir() else [source]:
                digest.update(file.name.encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    digest.update(repr((modules,)).encode())
    return digest.hexdigest()
