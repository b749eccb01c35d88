"""A real server with Ray Serve, HAProxy and two replicas, called by the unmodified client over HTTP and gRPC."""

import os
import signal
from collections.abc import Callable

import numpy as np
import pytest
import tritonclient.grpc
from tritonclient.utils import InferenceServerException

from league.registry.registry import Registry
from serve_app.inference_protocol.statistics import REPORT
from tests.support.clients.protocol_observations import observations, policy_of
from tests.support.clients.triton import FORMS, Triton, assert_same
from tests.support.leagues.served_leagues import promote
from tests.support.servers.protocol_servers import Address
from tests.support.servers.under_load import RayServer, load, processes, serving
from tests.support.waiting import until

pytestmark = pytest.mark.slow  # a real server takes all cores


@pytest.fixture(scope="module")
def served(ray_server: RayServer) -> Registry:
    return ray_server.registry


@pytest.fixture(scope="module")
def address(ray_server: RayServer) -> Address:
    promote(ray_server.registry, "board", 1)
    until(lambda: serving(ray_server.registry, 1) >= 2)
    return Address(ray_server.url.removeprefix("http://"), ray_server.grpc)


@pytest.mark.e2e
def test_each_form_of_the_client_is_answered(address: Address, served: Registry) -> None:
    for model in ("board", "pistons", "chess", "vector", "choice"):
        policy, signature = policy_of(served.storage, model)
        arrays = observations(signature, 4)
        for form in FORMS:
            with Triton(form, address) as triton:
                assert triton.call("is_server_live"), form
                assert triton.call("is_server_ready"), form
                assert triton.call("is_model_ready", model, "champion"), (model, form)
                assert_same(triton.infer(model, arrays).as_numpy("action"), policy.act(arrays).actions)


def test_calls_on_one_channel_reach_all_replicas(address: Address, served: Registry) -> None:
    """HAProxy balances calls, not connections."""
    with Triton("grpc", address) as triton:
        wait_for_both_replicas(triton, served)


def wait_for_both_replicas(triton: Triton, served: Registry) -> None:
    """Both report to the registry that they have answered."""

    def have_answered() -> bool:
        for _ in range(4):
            triton.infer("vector", {"observation": np.zeros((1, 2), np.float32)})
        reports = served.replicas.reports().values()
        return sum(any(each["name"] == "vector" for each in report[REPORT]) for report in reports) == 2

    until(have_answered)


@pytest.mark.parametrize("form", ["http", "grpc"])
def test_all_replicas_report_the_sum_of_their_statistics(address: Address, form: str) -> None:
    """Soon after the last request, each answers with the number of requests that clients sent."""
    calls = 20
    with Triton(form, address) as triton:

        def counts() -> set[int]:
            """From as many calls as reach both replicas."""
            entries = [triton.document("get_inference_statistics", "choice", "1")["model_stats"][0] for _ in range(8)]
            return {int(entry["inference_stats"]["success"].get("count", 0)) for entry in entries}

        until(lambda: len(counts()) == 1)
        (before,) = counts()
        for _ in range(calls):
            triton.infer("choice", {"observation": np.zeros(1, np.int64)})
        until(lambda: counts() == {before + calls})


def test_a_promotion_applies_to_both_protocols(address: Address, served: Registry) -> None:
    with Triton("http", address) as http, Triton("grpc", address) as rpc:
        for version in (2, 3, 1):
            promote(served, "board", version)
            until(lambda version=version: serving(served, version) == 2)
            arrays = observations(policy_of(served.storage, "board")[1], 1)
            for triton in (http, rpc):
                response = triton.infer("board", arrays).get_response()
                found = response["model_version"] if triton.is_http else response.model_version
                assert found == str(version)


@pytest.mark.e2e
def test_retried_calls_survive_the_death_of_a_replica(address: Address, served: Registry) -> None:
    arrays = {"observation": np.zeros((1, 2), np.float32)}
    with Triton("grpc", address) as triton:
        wait_for_both_replicas(triton, served)
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
