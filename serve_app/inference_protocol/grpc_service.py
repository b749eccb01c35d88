"""The protocol over gRPC: what each call answers, from the same policies as REST."""

from collections.abc import Awaitable, Callable
from typing import Any

import grpc
from google.protobuf.json_format import ParseDict
from google.protobuf.message import Message

from league.errors import ArtifactCorrupt, BodyTooLarge, NotFound, NotReady, StorageError
from serve_app.alias_watcher import AliasWatcher
from serve_app.doors import Doors
from serve_app.inference_protocol import open_inference_pb2 as messages
from serve_app.inference_protocol.catalogue import Catalogue, Document
from serve_app.inference_protocol.grpc_messages import read_request, write_response
from serve_app.inference_protocol.inference import Inference
from serve_app.inference_protocol.peers import is_of
from serve_app.settings import ServeSettings


class InferenceService:
    """The calls of a replica. `machine` is the address by which its node is known."""

    def __init__(
        self,
        inference: Inference,
        catalogue: Catalogue,
        watcher: AliasWatcher,
        doors: Doors,
        settings: ServeSettings,
        machine: str,
    ) -> None:
        self._inference = inference
        self._catalogue = catalogue
        self._watcher = watcher
        self._doors = doors
        self._settings = settings
        self._machine = machine
        self.rpcs: dict[str, Callable[[Any], Awaitable[Message]]] = {
            "ServerLive": self._server_live,
            "ServerReady": self._server_ready,
            "ModelReady": self._model_ready,
            "ServerMetadata": self._server_metadata,
            "ModelMetadata": self._model_metadata,
            "ModelConfig": self._model_config,
            "ModelInfer": self._model_infer,
            "ModelStatistics": self._model_statistics,
            "RepositoryIndex": self._repository_index,
        }

    async def call(self, rpc: str, request: Message, context: grpc.aio.ServicerContext) -> Message:
        """Answer a call. Raises LeagueError."""
        if self._settings.grpc_local_only and not is_of(context.peer(), self._machine):
            raise NotReady("a replica answers gRPC from its own machine alone: call the server's port")
        model = getattr(request, "model_name", "") or getattr(request, "name", "")
        self._doors.admit_rpc(context.invocation_metadata(), rpc, model)
        if request.ByteSize() > self._settings.max_body:
            raise BodyTooLarge(f"the message is larger than {self._settings.max_body} bytes")
        return await self.rpcs[rpc](request)

    async def _server_live(self, _: Message) -> Message:
        return messages.ServerLiveResponse(live=True)

    async def _server_ready(self, _: Message) -> Message:
        return messages.ServerReadyResponse(ready=self._watcher.is_ready)

    async def _model_ready(self, request: messages.ModelReadyRequest) -> Message:
        try:
            await self._inference.find(request.name, request.version)
        except (NotFound, NotReady, ArtifactCorrupt, StorageError):
            return messages.ModelReadyResponse(ready=False)
        return messages.ModelReadyResponse(ready=True)

    async def _server_metadata(self, _: Message) -> Message:
        return _message(self._catalogue.server(), messages.ServerMetadataResponse())

    async def _model_metadata(self, request: messages.ModelMetadataRequest) -> Message:
        metadata = await self._catalogue.metadata(request.name, request.version)
        return _message(metadata, messages.ModelMetadataResponse())

    async def _model_config(self, request: messages.ModelConfigRequest) -> Message:
        config = await self._catalogue.config(request.name, request.version)
        return _message({"config": config}, messages.ModelConfigResponse())

    async def _model_statistics(self, request: messages.ModelStatisticsRequest) -> Message:
        statistics = await self._catalogue.statistics(request.name, request.version)
        return _message(statistics, messages.ModelStatisticsResponse())

    async def _repository_index(self, request: messages.RepositoryIndexRequest) -> Message:
        models = await self._catalogue.index(request.ready)
        return _message({"models": models}, messages.RepositoryIndexResponse())

    async def _model_infer(self, request: messages.ModelInferRequest) -> Message:
        with self._inference.admitted():
            return await self._inference.infer(read_request(request), write_response)


def _message(document: Document, empty: Message) -> Message:
    return ParseDict(document, empty)
