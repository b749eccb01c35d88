"""The real thing: Ray Serve, HAProxy and two replicas, asked by the stock client over HTTP and gRPC."""

import os
import signal
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import tritonclient.grpc
from tritonclient.utils import InferenceServerException

from league.registry.registry import Registry
from league.settings import Storage
from serve_app import haproxy
from serve_app.launch import running
from tests.serve_app.inference_protocol.conftest import Address
from tests.serve_app.inference_protocol.leagues import every_kind
from tests.serve_app.inference_protocol.observations import observations, policy_of
from tests.serve_app.inference_protocol.triton import FORMS, Triton, same
from tests.serve_app.leagues import promote
from tests.serve_app.test_server import load, processes, serving, until


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    registry = every_kind(Storage.at(tmp_path_factory.mktemp("served")))
    yield registry
    registry.close()


@pytest.fixture(scope="module")
def address(served: Registry) -> Iterator[Address]:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    with running(served.storage, replicas=2, grpc_port=port) as url:
        until(lambda: serving(served, 1) == 2)
        yield Address(url.removeprefix("http://"), f"127.0.0.1:{port}")


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("model", ["board", "pistons", "chess", "vector", "choice"])
def test_every_form_of_the_client_is_answered(address: Address, served: Registry, form: str, model: str) -> None:
    policy, signature = policy_of(served.storage, model)
    arrays = observations(signature, 4)
    with Triton(form, address) as triton:
        assert triton.ask("is_server_live")
        assert triton.ask("is_server_ready")
        assert triton.ask("is_model_ready", model, "champion")
        same(triton.infer(model, arrays).as_numpy("action"), policy.act(arrays).actions)


def test_calls_of_one_channel_reach_every_replica(address: Address) -> None:
    """HAProxy balances calls, not connections: the two replicas' statistics differ."""
    with Triton("grpc", address) as triton:
        for _ in range(20):
            triton.infer("vector", {"observation": np.zeros((1, 2), np.float32)})
        found = set()

        def both() -> bool:
            (entry,) = triton.document("get_inference_statistics", "vector")["model_stats"]
            success = entry["inference_stats"]["success"]
            found.add(success["ns"])  # there is none where nothing was answered
            return len(found) == 2

        until(both)


def test_a_promotion_reaches_both_protocols(address: Address, served: Registry) -> None:
    with Triton("http", address) as http, Triton("grpc", address) as rpc:
        for version in (2, 3, 1):
            promote(served, "board", version)
            until(lambda version=version: serving(served, version) == 2)
            arrays = observations(policy_of(served.storage, "board")[1], 1)
            for triton in (http, rpc):
                response = triton.infer("board", arrays).get_response()
                found = response["model_version"] if triton.is_http else response.model_version
                assert found == str(version)


def test_the_death_of_a_replica_costs_no_call_that_is_repeated(address: Address, served: Registry) -> None:
    arrays = {"observation": np.zeros((1, 2), np.float32)}
    victim = processes(served.storage, "PolicyServer")[0]

    def caller() -> Callable[[], int]:
        client = tritonclient.grpc.InferenceServerClient(address.grpc)
        tensor = tritonclient.grpc.InferInput("observation", [1, 2], "FP32")
        tensor.set_data_from_numpy(arrays["observation"])

        def call() -> int:
            for _ in range(3):
                try:
                    return int(client.infer("vector", [tensor]).get_response().model_version)
                except InferenceServerException as error:
                    failure = error
            raise failure

        return call

    with load(caller, callers=4) as seen:
        until(lambda: seen.versions.total() > 200)
        os.kill(victim, signal.SIGKILL)
        after = seen.versions.total()
        until(lambda: seen.versions.total() > after + 1000)
    assert seen.failures == []
    until(lambda: len(set(processes(served.storage, "PolicyServer")) - {victim}) == 2)
