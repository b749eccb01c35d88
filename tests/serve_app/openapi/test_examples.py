"""The generated examples are valid requests for the served policies."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from league.settings import Storage
from league.spaces import Box, DictSpace, Discrete, MultiBinary, MultiDiscrete, Space
from league.spaces.observation_codec import ObservationReader
from serve_app.openapi.document import observation
from tests.support.leagues.protocol_leagues import every_kind
from tests.support.servers.replicas import QUICK, replica


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    storage = Storage.at(tmp_path_factory.mktemp("kinds"))
    every_kind(storage).close()
    with replica(storage, QUICK) as client:
        yield client


def examples(client: TestClient, path: str) -> dict[str, Any]:
    post = client.get("/openapi.json").json()["paths"][path]["post"]
    every = post["requestBody"]["content"]["application/json"]["examples"].values()
    return {each["x-model"]: each["value"] for each in every if "x-model" in each}


def test_each_served_policy_has_a_valid_action_example(kinds: TestClient) -> None:
    found = examples(kinds, "/v1/policies/{model}/action")
    assert set(found) == {
        *("board", "memory", "vector", "nested", "kinds", "chess", "pistons", "choice", "duo.left", "duo.right")
    }
    for model, body in found.items():
        reply = kinds.post(f"/v1/policies/{model}/action", json=body)
        assert reply.status_code == 200, (model, reply.text)
    assert "png" in found["pistons"]["observation"]
    assert "b64" in found["chess"]["observation"]["observation"]
    assert "state" in found["memory"]


@pytest.mark.parametrize("at", ["", "/versions/{version}"])
def test_policies_with_small_inputs_have_a_valid_inference_example(kinds: TestClient, at: str) -> None:
    found = examples(kinds, "/v2/models/{model}" + at + "/infer")
    assert {"board", "kinds", "duo.left"} <= set(found)
    assert not {"chess", "pistons"} & set(found)
    for model, body in found.items():
        reply = kinds.post("/v2/models/" + model + at.format(version=1) + "/infer", json=body)
        assert reply.status_code == 200, (model, reply.text)


@pytest.mark.parametrize(
    "space",
    [
        Box(dtype="float32", shape=(2,), low=[1.0, None], high=[2.0, None]),
        Box(dtype="int16", shape=(), low=-5, high=-2),
        Box(dtype="uint8", shape=(30, 30), low=0, high=255),
        Box(dtype="uint8", shape=(20, 20, 3), low=0, high=255),
        Box(dtype="uint8", shape=(20, 20, 5), low=0, high=255),
        Box(dtype="float64", shape=(600,), low=None, high=None),
        Discrete(n=3, start=-4),
        MultiDiscrete(nvec=[2, 3], start=[5, 6], shape=(2,)),
        MultiBinary(shape=(3,)),
        DictSpace(spaces={"a": Discrete(n=2, start=1), "b": DictSpace(spaces={"c": MultiBinary(shape=(2,))})}),
    ],
    ids=lambda space: str(space.type),
)
def test_an_example_is_in_its_space(space: Space) -> None:
    value = observation(space)
    arrays = ObservationReader(space).read([value])
    if isinstance(space, Box):
        low = np.array(-np.inf if space.low is None else space.low, float)
        assert (arrays["observation"] >= np.nan_to_num(low, nan=-np.inf)).all()
