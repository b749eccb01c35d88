"""Writes versions into MLflow's model registry, in its ONNX flavour: a registered model for each policy of a league."""

import importlib
import os
import re
from collections.abc import Mapping
from importlib.util import find_spec

import numpy as np
import onnx

from league.errors import ConfigError, StorageError, one_line
from league.registry.storage.exports import CARD
from league.registry.storage.manifest import MANIFEST, Tensor
from league.registry.storage.rows import VersionRow


def register_models(version: VersionRow, files: Mapping[str, bytes], card: str, uri: str | None) -> list[str]:
    """Register the policies of a version. The run in MLflow that they belong to has the manifest and the card.

    Args:
        version: The version, not a mixture.
        files: Name → content of its graphs and its manifest.
        card: Its model card.
        uri: Of MLflow's tracking server or store; None for MLflow's own setting, `MLFLOW_TRACKING_URI`.

    Returns:
        The URIs of the models, `models:/connect_four/1`. With several policies, names have the form LEAGUE-POLICY.

    Raises:
        ConfigError: MLflow is not installed.
        StorageError: MLflow failed. A run that could not be completed is marked as failed, and registers nothing.
    """
    if find_spec("mlflow") is None:
        raise ConfigError("--mlflow requires a package: pip install 'policy-league[mlflow]'")
    mlflow = importlib.import_module("mlflow")
    flavour, models, types = (importlib.import_module(f"mlflow.{name}") for name in ("onnx", "models", "types"))

    def schema(tensors: tuple[Tensor, ...]) -> object:
        return types.Schema(
            [
                types.TensorSpec(np.dtype(tensor.dtype), tuple(size or -1 for size in tensor.shape), tensor.name)
                for tensor in tensors
            ]
        )

    about = {"league": version.league, "version": version.ref, "sha256": version.sha256}
    manifest, registered = version.manifest, []
    try:
        if uri is not None:
            mlflow.set_tracking_uri(uri)
        mlflow.set_experiment(os.environ.get("MLFLOW_EXPERIMENT_NAME", version.league))
        with mlflow.start_run(run_name=version.ref, tags=about):
            mlflow.log_text(files[MANIFEST].decode(), MANIFEST)
            mlflow.log_text(card, CARD)
            logged = [
                flavour.log_model(
                    onnx.load_model_from_string(files[policy.file]),
                    name=_allowed(name),
                    signature=models.ModelSignature(schema(policy.inputs), schema(policy.outputs)),
                    pip_requirements=["onnxruntime", "numpy"],
                    metadata=about | {"policy": name},
                )
                for name, policy in manifest.policies.items()
            ]
        for policy, model in zip(manifest.policies, logged, strict=True):
            suffix = "" if len(logged) == 1 else f"-{policy}"
            entry = mlflow.register_model(model.model_uri, _allowed(version.league + suffix), tags=about)
            registered.append(f"models:/{entry.name}/{entry.version}")
    except Exception as error:  # whatever a store raises: of HTTP, a database or a disk
        raise StorageError(f"MLflow at {uri or 'MLFLOW_TRACKING_URI'}: {one_line(error, with_type=True)}") from error
    return registered


def _allowed(name: str) -> str:
    """Return a name without the characters that MLflow reserves."""
    return re.sub(r"[^\w -]", "-", name)
