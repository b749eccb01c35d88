"""What there is to ask for: the server, its models with their inputs and outputs, and the repository's index.

Everything is a JSON document of the protocol, which gRPC's messages are made from, too.
"""

from collections.abc import Iterable
from importlib.metadata import version as installed
from typing import Any

from league.errors import StorageError
from league.registry.registry import Registry
from serve_app.inference_protocol.inference import Inference, Served
from serve_app.inference_protocol.signature import Port
from serve_app.inference_protocol.statistics import Entry
from serve_app.models import Models
from serve_app.settings import ServeSettings
from serve_app.versions import Versions

PACKAGE = "policy-league"
PLATFORM = "onnxruntime_onnx"
BACKEND = "onnxruntime"
EXTENSIONS = ["binary_tensor_data", "model_configuration", "model_repository", "statistics"]
LOADED_LATER = "it is loaded when it is asked for"

Document = dict[str, Any]


class Catalogue:
    """Describes what a replica serves."""

    def __init__(self, models: Models, versions: Versions, inference: Inference, settings: ServeSettings) -> None:
        self._models = models
        self._versions = versions
        self._inference = inference
        self._settings = settings

    def server(self) -> Document:
        """Name, version and the protocol's extensions that are there."""
        return {"name": PACKAGE, "version": installed(PACKAGE), "extensions": EXTENSIONS}

    async def metadata(self, model: str, version: str) -> Document:
        """Inputs and outputs, -1 for the batch. Without a database, only the version asked for is told.

        Raises what `Models.find` raises.
        """
        served = await self._inference.find(model, version)
        league = served.version.league
        try:
            numbers = (await self._models.ask(lambda registry: registry.version_numbers(league)))[league]
        except StorageError:
            numbers = [served.version.number]
        return {
            "name": model,
            "versions": [str(number) for number in numbers],
            "platform": PLATFORM,
            "inputs": _tensors(served.signature.inputs.values()),
            "outputs": _tensors(served.signature.outputs.values()),
        }

    async def config(self, model: str, version: str) -> Document:
        """Triton's model configuration. Raises what `Models.find` raises."""
        served = await self._inference.find(model, version)
        signature = served.signature
        return {
            "name": model,
            "platform": PLATFORM,
            "backend": BACKEND,
            "max_batch_size": self._settings.max_batch,
            "input": [_configured(port) | {"optional": port.is_state} for port in signature.inputs.values()],
            "output": [_configured(port) for port in signature.outputs.values()],
        }

    async def statistics(self, model: str = "", version: str = "") -> Document:
        """Of all models, of all versions of one, or of one version. Raises what `Models.find` raises."""
        statistics = self._inference.statistics
        if not model:
            return {"model_stats": statistics.documents()}
        served = await self._inference.find(model, version)
        found = statistics.documents(served.name, served.version.number if version else None)
        return {"model_stats": found or [_unused(served)]}

    async def index(self, only_ready: bool = False) -> list[Document]:
        """Every version of every policy; those in memory are ready, the others are by the time they answer.

        Raises StorageError.
        """
        policies, numbers = await self._models.ask(_published)
        loaded = self._versions.loaded()
        return [
            {"name": name, "version": str(number)} | state
            for league, names in policies.items()
            for number in numbers.get(league, [])
            for state in [_state((league, number) in loaded)]
            if state["state"] == "READY" or not only_ready
            for name in names
        ]


def _published(registry: Registry) -> tuple[dict[str, list[str]], dict[str, list[int]]]:
    """league → names of its models, and → numbers of its versions."""
    models = {}
    for row in registry.leagues():
        policies = row.interface.policy_ids
        models[row.slug] = [row.slug] if len(policies) == 1 else [f"{row.slug}.{policy}" for policy in policies]
    return models, registry.version_numbers()


def _state(is_loaded: bool) -> Document:
    return {"state": "READY"} if is_loaded else {"state": "UNAVAILABLE", "reason": LOADED_LATER}


def _tensors(ports: Iterable[Port]) -> list[Document]:
    return [{"name": port.name, "datatype": port.datatype, "shape": [-1, *port.leaf.shape]} for port in ports]


def _configured(port: Port) -> Document:
    return {"name": port.name, "data_type": f"TYPE_{port.datatype}", "dims": list(port.leaf.shape)}


def _unused(served: Served) -> Document:
    return Entry().document(served.name, served.version.number)
