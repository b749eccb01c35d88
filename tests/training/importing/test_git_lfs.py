"""Files that Git LFS has not fetched."""

from pathlib import Path

import onnx
import pytest

from league.errors import ConfigError
from tests.support.leagues.registries import interface
from tests.support.policies.foreign_graphs import foreign
from training.importing.open_source import open_sources

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 12345\n"


def test_a_pointer_is_named(tmp_path: Path, subtests: pytest.Subtests) -> None:
    """Before trust is asked for, and instead of what the library for the format says about it."""
    onnx.save(
        onnx.load_from_string(foreign(18, 9, shape=(3, 3, 2))), str(tmp_path / "graph.onnx"),
        save_as_external_data=True, location="weights.bin", size_threshold=0,
    )  # fmt: skip
    for name in ("model.onnx", "model.pt2", "model.zip", "weights.bin", "checkpoint/state.pkl", "statistics.pkl"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(POINTER)
    (tmp_path / "sb3.zip").write_bytes(b"anything")
    for source, options, pointer in (
        ("model.onnx", {}, "model.onnx"),
        ("model.pt2", {}, "model.pt2"),
        ("model.zip", {"kind": "sb3"}, "model.zip"),
        ("graph.onnx", {}, "weights.bin"),
        ("checkpoint", {"kind": "rllib"}, "checkpoint/state.pkl"),
        ("sb3.zip", {"kind": "sb3", "vec_normalize": tmp_path / "statistics.pkl", "trust": True}, "statistics.pkl"),
    ):
        with subtests.test(source), pytest.raises(ConfigError) as refusal:
            open_sources(tmp_path / source, interface(), **options)
        assert str(refusal.value).startswith(f"{tmp_path / pointer} is a Git LFS pointer"), source
