"""API keys in both protocols, sent by the unmodified client as a header or as metadata."""

import threading
from collections.abc import Iterator

import grpc
import numpy as np
import pytest
from tritonclient.utils import InferenceServerException

from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from serve_app.inference_protocol import grpc_handlers
from tests.support.clients.triton import FORMS, Triton
from tests.support.leagues.served_leagues import everything
from tests.support.servers.protocol_servers import InProcess, Listening
from tests.support.servers.replicas import QUICK

VECTOR = {"observation": np.zeros((1, 2), np.float32)}
STATUS = {
    "unknown": {True: "401", False: "StatusCode.UNAUTHENTICATED"},
    "wrong": {True: "403", False: "StatusCode.PERMISSION_DENIED"},
}


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[InProcess, dict[str, str]]]:
    """A replica that requires keys, and a token for each scope."""
    registry = everything(Storage.at(tmp_path_factory.mktemp("locked")))
    tokens = {scope: registry.keys.create(scope, [scope])[1] for scope in ("act", "read")}
    with Listening(Replica(Registry.open(registry.storage), QUICK, "replica-1")) as address:
        yield address, tokens
    registry.close()


@pytest.mark.parametrize("form", FORMS)
def test_a_key_is_limited_to_its_scope(locked: tuple[InProcess, dict[str, str]], form: str) -> None:
    address, tokens = locked
    acts, reads = ({"authorization": f"Bearer {tokens[scope]}"} for scope in ("act", "read"))
    with Triton(form, address) as triton:

        def assert_rejected(reason: str, call: str, *arguments: object, **options: object) -> None:
            with pytest.raises(InferenceServerException) as caught:
                (triton.infer if call == "infer" else triton.call)(*arguments, **options)  # type: ignore[operator]
            assert caught.value.status() == STATUS[reason][triton.is_http]

        assert triton.infer("vector", VECTOR, headers=acts).as_numpy("action") is not None
        assert triton.call("get_model_metadata", "vector", headers=reads)
        assert triton.call("is_server_ready")
        assert_rejected("unknown", "infer", "vector", VECTOR)
        assert_rejected(
            "unknown", "infer", "vector", VECTOR, headers={"authorization": f"Bearer {tokens['act'][:-1]}x"}
        )
        assert_rejected("wrong", "infer", "vector", VECTOR, headers=reads)
        assert_rejected("unknown", "get_model_metadata", "get_model_metadata", "vector")
        assert_rejected("wrong", "get_model_repository_index", "get_model_repository_index", headers=acts)


@pytest.mark.parametrize("rpc", ["ModelInfer", "ModelReady", "ModelStatistics", "RepositoryIndex", "ServerMetadata"])
def test_a_caller_without_a_key_is_refused_before_its_message_arrives(
    locked: tuple[InProcess, dict[str, str]], rpc: str
) -> None:
    address, _ = locked
    ends = threading.Event()

    def never() -> Iterator[bytes]:
        ends.wait()
        yield b""

    with grpc.insecure_channel(address.grpc) as channel:
        with pytest.raises(grpc.RpcError) as caught:
            channel.stream_unary(f"/{grpc_handlers.SERVICE}/{rpc}")(never(), timeout=4)
        ends.set()
    assert caught.value.code() == grpc.StatusCode.UNAUTHENTICATED  # type: ignore[attr-defined]
