"""`league export` as a Hugging Face folder and into MLflow's model registry."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from league.registry.registry import Registry
from league.registry.storage.exports import CARD
from tests.support.command import League
from training.importing import checks


def test_a_folder_for_the_hub_can_be_imported(
    league: League, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks, "IMPORTED", replace(checks.IMPORTED, observations=300))
    folder = tmp_path / "new" / "folder"
    result = league("export", "tictactoe@3", "--hub", str(folder))
    assert result.code == 0
    assert sorted(path.name for path in folder.iterdir()) == [CARD, "manifest.json", "shared.onnx"]
    assert [path.name for path in folder.parent.iterdir()] == ["folder"]
    assert f"{folder / CARD}\n" in result.out
    assert league("import", "tictactoe", str(folder)).code == 0


def test_a_folder_for_the_hub_is_new_or_empty(league: League, registry: Registry, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    assert league("export", "tictactoe@3", str(folder), "--hub").code == 0
    (folder / CARD).write_text("mine")
    result = league("export", "tictactoe@3", str(folder), "--hub")
    assert (result.code, f"{folder}: expected a new or empty folder" in result.err) == (2, True)
    assert league("export", "tictactoe@3", str(folder / CARD), "--hub").code == 2
    assert (folder / CARD).read_text() == "mine"


def test_nothing_is_written_of_a_damaged_version(league: League, registry: Registry, tmp_path: Path) -> None:
    (registry.artifacts.path("tictactoe", 3) / "shared.onnx").write_bytes(b"damaged")
    result = league("export", "tictactoe@3", str(tmp_path / "folder"), "--hub")
    assert (result.code != 0, "shared.onnx was changed" in result.err) == (True, True)
    assert not (tmp_path / "folder").exists()


def test_one_target_at_a_time(league: League, registry: Registry) -> None:
    result = league("export", "tictactoe@3", "--hub", "--mlflow")
    assert (result.code, "--hub and --mlflow have different targets" in result.err) == (2, True)


def test_a_missing_mlflow_is_named(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mlflow", None)
    result = league("export", "tictactoe@3", "--mlflow")
    assert (result.code, "pip install 'policy-league[mlflow]'" in result.err) == (2, True)


@pytest.mark.slow
def test_a_registered_model_of_mlflow_acts(
    league: League, registry: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = pytest.importorskip("mlflow", reason="pip install mlflow-skinny")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    store = f"file:{tmp_path / 'mlruns'}"
    assert league("export", "tictactoe@3", "--mlflow", store).out == "models:/tictactoe/1\n"
    assert league("export", "tictactoe@3", store, "--mlflow").out == "models:/tictactoe/2\n"
    mlflow.set_tracking_uri(store)
    model = mlflow.pyfunc.load_model("models:/tictactoe/2")
    inputs = {"observation": np.zeros((1, 3, 3, 2), np.int8), "action_mask": np.eye(9, dtype=np.int8)[[5]]}
    assert model.predict(inputs)["action"].tolist() == [5]
    client = mlflow.MlflowClient()
    entry = client.get_model_version("tictactoe", "2")
    assert entry.tags["sha256"] == registry.versions.get("tictactoe", 3).sha256
    assert {file.path for file in client.list_artifacts(entry.run_id)} >= {CARD, "manifest.json"}


@pytest.mark.slow
def test_an_mlflow_that_does_not_answer(league: League, registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mlflow", reason="pip install mlflow-skinny")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    result = league("export", "tictactoe@3", "http://127.0.0.1:9", "--mlflow")
    assert "MLflow at http://127.0.0.1:9: MlflowException" in result.err
    assert result.code == 1
