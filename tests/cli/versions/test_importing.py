"""`league import` and `league export`."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from league.policies import load
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from tests.support.command import League
from tests.support.policies.foreign_graphs import foreign
from training.importing import checks


@pytest.fixture(autouse=True)
def few_observations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "IMPORTED", replace(checks.IMPORTED, observations=300))


def test_an_imported_model_can_be_promoted(league: League, registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "foreign.onnx"
    path.write_bytes(foreign(18, 9, shape=(3, 3, 2)))
    result = league("import", "tictactoe", str(path), "--note", "made elsewhere")
    assert "tictactoe@4 is published" in result.out
    assert "0 of 3" in result.out
    version = registry.versions.get("tictactoe", 4)
    assert version.note is not None
    assert version.note.text == "made elsewhere"
    assert league("promote", "tictactoe@4", "--yes").code == 0


def test_an_exported_version_can_be_imported(league: League, registry: Registry, tmp_path: Path) -> None:
    out = tmp_path / "exported"
    assert league("export", "tictactoe@3", str(out)).code == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert {policy["file"] for policy in manifest["policies"].values()} <= {file.name for file in out.iterdir()}
    OnnxPolicy(out / "shared.onnx")
    assert league("import", "tictactoe", str(out)).code == 0
    load("tictactoe@4", registry=registry)


@pytest.mark.parametrize("options", [["--rllib"], ["--sb3"], []])
def test_formats_that_run_code_require_trust(
    league: League, registry: Registry, tmp_path: Path, options: list[str]
) -> None:
    for name in ("shared.zip", "shared.pt2"):
        (tmp_path / name).write_bytes(b"anything")
    result = league("import", "tictactoe", str(tmp_path), *options)
    assert result.code == 2
    assert "runs code from it: add --trust if you trust its author" in result.err


def test_a_missing_file_is_named(league: League, registry: Registry) -> None:
    result = league("import", "tictactoe", "nowhere.onnx")
    assert (result.code, "nowhere.onnx: no such file" in result.err) == (2, True)
