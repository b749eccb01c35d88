"""Describes the server and its models in the Open Inference Protocol: metadata, configuration, statistics and the
index.

Descriptions are JSON documents, from which the gRPC messages are built, too.
"""

from collections.abc import Awaitable, Callable, Iterable
from importlib.metadata import version as installed

from league.errors import StorageError
from league.registry.registry import Registry
from serve_app.inference_protocol.inference import Inference
from serve_app.inference_protocol.statistics import REPORT, Document, ModelStatistics, sum_documents
from serve_app.live_versions.policies import Port
from serve_app.live_versions.resolver import ModelResolver
from serve_app.live_versions.version_cache import VersionCache
from serve_app.settings import ServeSettings

PACKAGE = "policy-league"
PLATFORM = "onnxruntime_onnx"
BACKEND = "onnxruntime"
EXTENSIONS = ["binary_tensor_data", "model_configuration", "model_repository", "statistics"]
NOT_LOADED = "loaded on demand"


class ModelCatalogue:
    """Describes the models of a server. `report` writes the statistics of this replica to the registry."""

    def __init__(
        self,
        models: ModelResolver,
        versions: VersionCache,
        inference: Inference,
        settings: ServeSettings,
        report: Callable[[], Awaitable[None]],
    ) -> None:
        self._models = models
        self._versions = versions
        self._inference = inference
        self._settings = settings
        self._report = report

    def server(self) -> Document:
        """Name, version and supported extensions of the server."""
        return {"name": PACKAGE, "version": installed(PACKAGE), "extensions": EXTENSIONS}

    async def metadata(self, model: str, version: str) -> Document:
        """Inputs and outputs, with -1 for the batch. Without a database, lists the requested version only.

        Raises the errors of `ModelResolver.find`.
        """
        policy = await self._inference.find(model, version)
        league = policy.league
        try:
            numbers = await self._models.in_registry_thread(lambda registry: registry.versions.numbers(league)[league])
        except StorageError:
            numbers = [policy.number]
        return {
            "name": model,
            "versions": [str(number) for number in numbers],
            "platform": PLATFORM,
            "inputs": _tensors(policy.inputs.values()),
            "outputs": _tensors(policy.outputs.values()),
        }

    async def config(self, model: str, version: str) -> Document:
        """Triton's model configuration. Raises the errors of `ModelResolver.find`."""
        policy = await self._inference.find(model, version)
        return {
            "name": model,
            "platform": PLATFORM,
            "backend": BACKEND,
            "max_batch_size": self._settings.max_batch,
            "input": [_configured(port) | {"optional": port.is_state} for port in policy.inputs.values()],
            "output": [_configured(port) for port in policy.outputs.values()],
        }

    async def statistics(self, model: str = "", version: str = "") -> Document:
        """Statistics of all models, all versions of a model, or one version. The version that answers is always listed.

        Sums over all replicas. Those of other replicas are from their last reports, which they write every few seconds,
        and whenever they are asked. Without a database, there are only those of this replica.

        Raises the errors of `ModelResolver.find`.
        """
        try:
            await self._report()  # first, so that no later answer, by any replica, has less
            reports = await self._models.in_registry_thread(lambda registry: registry.replicas.reports())
            documents = [document for report in reports.values() for document in report.get(REPORT, ())]
        except StorageError:
            documents = self._inference.statistics.documents()
        documents = sum_documents(documents)
        if not model:
            return {"model_stats": documents}
        policy = await self._inference.find(model, version)
        model_documents = [document for document in documents if document["name"] == policy.model]
        if version:
            model_documents = [document for document in model_documents if document["version"] == str(policy.number)]
        if all(document["version"] != str(policy.number) for document in model_documents):
            model_documents.append(ModelStatistics(policy.model, policy.number).document)
        return {"model_stats": model_documents}

    async def index(self, only_ready: bool = False) -> list[Document]:
        """All versions of all policies. Versions in memory are ready; others are loaded on demand. Raises
        StorageError."""
        policies, numbers = await self._models.in_registry_thread(_models_and_versions)
        loaded = self._versions.cached_keys()
        return [
            {"name": name, "version": str(number)} | state
            for league, names in policies.items()
            for number in numbers.get(league, [])
            for state in [_state((league, number) in loaded)]
            if state["state"] == "READY" or not only_ready
            for name in names
        ]


def _models_and_versions(registry: Registry) -> tuple[dict[str, list[str]], dict[str, list[int]]]:
    """league → names of its models, and league → numbers of its versions."""
    models = {}
    for league, policies in registry.leagues.policy_ids().items():
        models[league] = [league] if len(policies) == 1 else [f"{league}.{policy}" for policy in policies]
    return models, registry.versions.numbers()


def _state(is_loaded: bool) -> Document:
    return {"state": "READY"} if is_loaded else {"state": "UNAVAILABLE", "reason": NOT_LOADED}


def _tensors(ports: Iterable[Port]) -> list[Document]:
    return [{"name": port.name, "datatype": port.datatype, "shape": [-1, *port.leaf.shape]} for port in ports]


def _configured(port: Port) -> Document:
    return {"name": port.name, "data_type": f"TYPE_{port.datatype}", "dims": list(port.leaf.shape)}
