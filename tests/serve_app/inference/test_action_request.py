"""Encodings and options of action requests: base64, images, probabilities, state tokens."""

import json
import shutil
from base64 import b64encode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.codecs.request_limits import LARGE_BODY
from tests.support.clients.actions import BOARD, act, boards, rejected
from tests.support.leagues.protocol_leagues import DTYPES, FRAME, every_kind
from tests.support.leagues.served_leagues import MEMORY, build_everything, promote, publish, register
from tests.support.pictures import png
from tests.support.policies.graphs import counting, masked_mlp
from tests.support.servers.replicas import QUICK, replica
from tests.support.waiting import until


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A replica with all dtypes and images, for tests that do not change its data."""
    storage = Storage.at(tmp_path_factory.mktemp("kinds"))
    every_kind(storage).close()
    with replica(storage, QUICK.model_copy(update={"max_body": 2**20, "max_batch": 3000})) as client:
        yield client


def b64(array: Any, **more: Any) -> dict[str, Any]:
    array = np.asarray(array)
    data = array.astype(array.dtype.newbyteorder("<")).tobytes()
    return {"b64": b64encode(data).decode()} | more


def b64_board(board: dict[str, Any]) -> dict[str, Any]:
    return {name: b64(np.array(value, np.int8)) for name, value in board.items()}


def frames(count: int) -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (count, *FRAME), dtype=np.uint8)


def image(pixels: np.ndarray) -> dict[str, str]:
    return {"png": b64encode(png(pixels)).decode()}


def test_base64_gets_the_actions_of_lists(read_only_client: TestClient) -> None:
    batch = boards(8)
    expected = act(read_only_client, observations=batch)["actions"]
    assert act(read_only_client, observations=[b64_board(board) for board in batch])["actions"] == expected
    mixed = [b64_board(board) if row % 2 else board for row, board in enumerate(batch)]
    assert act(read_only_client, observations=mixed)["actions"] == expected
    half = {"observation": batch[0]["observation"], "action_mask": b64_board(batch[0])["action_mask"]}
    assert act(read_only_client, observation=half)["action"] == expected[0]


def test_base64_supports_each_dtype(kinds: TestClient) -> None:
    random = np.random.default_rng(0)
    arrays = {dtype: random.integers(0, 2, (2, 3)).astype(dtype) for dtype in DTYPES}
    lists = {dtype: array.tolist() for dtype, array in arrays.items()}
    encoded = {dtype: b64(array, dtype=dtype, shape=[2, 3]) for dtype, array in arrays.items()}
    assert act(kinds, "kinds", observation=encoded)["action"] == act(kinds, "kinds", observation=lists)["action"]


def test_metadata_of_base64_must_match(read_only_client: TestClient) -> None:
    mask = b64(np.ones(7, np.int8))
    for leaf, message in (
        (b64(np.ones(7, np.float32)), "holds 28 bytes, expected 7"),
        (mask | {"dtype": "float32"}, "nothing is converted"),
        (mask | {"shape": [1, 7]}, "has shape [1, 7], expected [7]"),
    ):
        error = rejected(read_only_client, {"observation": BOARD | {"action_mask": leaf}})
        assert (error["code"], message in error["message"]) == ("invalid_observation", True), error
    zeros = b64(np.zeros(7, np.int8))
    assert rejected(read_only_client, {"observation": BOARD | {"action_mask": zeros}})["code"] == "illegal_mask"
    infinite = b64(np.array([np.inf, 0], np.float32))
    assert "infinity" in rejected(read_only_client, {"observation": infinite}, model="vector")["message"]
    beyond = {"mode": b64(np.int64(9)), "sense": {"speed": [1, 1]}}
    assert "between 1 and 3" in rejected(read_only_client, {"observation": beyond}, model="nested")["message"]


def test_strings_beside_base64_are_rejected(read_only_client: TestClient) -> None:
    error = rejected(read_only_client, {"observation": b64_board(BOARD) | {"observation": [["0"]]}})
    assert "where a number is expected" in error["message"]


def test_an_image_gets_the_action_of_its_pixels(kinds: TestClient) -> None:
    for pixels in frames(3):
        expected = act(kinds, "pistons", observation=pixels.tolist())["action"]
        assert act(kinds, "pistons", observation=image(pixels))["action"] == expected
        assert act(kinds, "pistons", observation=b64(pixels))["action"] == expected
        stack = {"png": [image(pixels[..., [i]])["png"] for i in range(4)]}
        assert act(kinds, "pistons", observation=stack)["action"] == expected
    batch = [image(pixels) for pixels in frames(3)]
    alone = [act(kinds, "pistons", observation=each)["action"] for each in batch]
    assert act(kinds, "pistons", observations=batch)["actions"] == alone


def test_a_small_body_cannot_decode_to_a_large_batch(kinds: TestClient) -> None:
    black = image(np.zeros(FRAME, np.uint8))
    body = {"observations": [black] * 2500}  # 70 MB of pixels
    assert rejected(kinds, body, 413, "pistons")["code"] == "body_too_large"


def test_images_of_another_shape_are_rejected(kinds: TestClient) -> None:
    error = rejected(kinds, {"observation": image(np.zeros((84, 84, 3), np.uint8))}, model="pistons")
    assert (error["code"], "3 channels" in error["message"]) == ("invalid_observation", True)
    error = rejected(kinds, {"observation": image(np.zeros((2, 2), np.uint8))}, model="vector")
    assert "which png cannot encode" in error["message"]


def softmax(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    return weights / weights.sum(axis=1, keepdims=True)


def test_probabilities_are_returned_on_request(read_only_client: TestClient) -> None:
    policy, batch = OnnxPolicy(masked_mlp(seed=0)), boards(8)
    arrays = {name: np.array([board[name] for board in batch], np.int8) for name in BOARD}
    inputs = policy.distribution(arrays).dist_inputs
    assert inputs is not None
    reply = act(read_only_client, observations=batch, probabilities=True)
    assert reply["probabilities"] == [pytest.approx(row) for row in softmax(inputs)]
    assert [int(np.argmax(row)) for row in reply["probabilities"]] == reply["actions"]
    for board, row in zip(batch, reply["probabilities"], strict=True):
        assert [share == 0 for share in row] == [not allowed for allowed in board["action_mask"]]
    one = act(read_only_client, observation=batch[0], probabilities=True, explore=True, seed=3)
    assert one["probabilities"] == pytest.approx(reply["probabilities"][0])
    assert one["action"] == act(read_only_client, observation=batch[0], explore=True, seed=3)["action"]
    assert "probabilities" not in act(read_only_client, observation=batch[0], probabilities=False)


def test_a_continuous_policy_returns_mean_and_deviation(read_only_client: TestClient) -> None:
    """The graph outputs the observation as the mean and as the log standard deviation."""
    reply = act(read_only_client, "vector", observation=[0.5, -1.0], probabilities=True)
    assert reply["probabilities"] == {
        "mean": pytest.approx([0.5, -1.0]),
        "std": pytest.approx([np.exp(0.5), np.exp(-1)]),
    }


def act_with_state(client: TestClient, state: Any, version: Any = None, **body: Any) -> dict[str, Any]:
    body = body or {"observation": [1]}
    return act(client, "memory", version, state=state, **body)


def test_an_episode_continues_with_its_token(read_only_client: TestClient) -> None:
    state, actions = None, []
    for _ in range(4):
        reply = act_with_state(read_only_client, state)
        state = reply["state"]
        assert isinstance(state, str)
        actions.append(reply["action"])
    assert actions == [0, 0, 1, 1], "the sum exceeds 2"
    again = act_with_state(read_only_client, state)
    assert again["action"] == 1
    assert act_with_state(read_only_client, state) == again, "calls can be repeated"


def test_each_episode_of_a_batch_has_its_own_token(read_only_client: TestClient) -> None:
    tokens = act_with_state(read_only_client, None, observations=[[1], [2], [5]])["state"]
    assert len(set(tokens)) == 3
    reply = act_with_state(read_only_client, [tokens[2], None, tokens[0]], observations=[[0], [0], [2]])
    assert reply["actions"] == [1, 0, 1]
    assert act_with_state(read_only_client, [None, None], observations=[[1], [3]])["actions"] == [0, 1]
    assert isinstance(act_with_state(read_only_client, tokens[1])["state"], str), "a token of a batch can be used alone"


def test_a_token_is_valid_after_a_promotion(client: TestClient, registry: Registry) -> None:
    state = act_with_state(client, None)["state"]
    publish(registry, "memory", {"shared": counting()}, "run/2")
    promote(registry, "memory", 2)
    until(lambda: act_with_state(client, None)["version"] == 2)
    for expected in (0, 1, 1):
        reply = act_with_state(client, state)
        state = reply["state"]
        assert (reply["version"], reply["action"]) == (1, expected)
    assert act_with_state(client, state, "champion")["version"] == 1, "the alias was resolved when the episode started"
    assert act_with_state(client, state, 1)["version"] == 1
    error = rejected(client, {"observation": [1], "state": state}, model="memory", params={"version": "2"})
    assert (error["code"], "the request is for version 2" in error["message"]) == ("invalid_state", True)
    fresh = act_with_state(client, None)["state"]
    error = rejected(client, {"observations": [[1], [1]], "state": [state, fresh]}, model="memory")
    assert (error["code"], "several versions" in error["message"]) == ("invalid_state", True)


def test_a_pinned_version_answers_after_promotions(client: TestClient, registry: Registry) -> None:
    for champion in (2, 3, 1):
        promote(registry, "board", champion)
        until(lambda champion=champion: act(client, observation=BOARD)["version"] == champion)
        assert act(client, version=1, observation=BOARD)["version"] == 1


def test_a_removed_version_is_reported(client: TestClient, registry: Registry) -> None:
    state = act_with_state(client, None)["state"]
    for number in range(2, 2 + QUICK.cached_versions + 1):  # evicts version 1 from the cache
        publish(registry, "memory", {"shared": counting()}, f"run/{number}")
        act_with_state(client, None, number)
    promote(registry, "memory", 2)
    until(lambda: act_with_state(client, None)["version"] == 2)
    act_with_state(client, None, 3)
    shutil.rmtree(registry.artifacts.path("memory", 1))
    for number in range(3, 3 + QUICK.cached_versions):
        act_with_state(client, None, number)
    for body, params in (({"observation": [1], "state": state}, {}), ({"observation": [1]}, {"version": "1"})):
        error = rejected(client, body, 410, "memory", params=params)
        assert (error["code"], "memory@1 was retired" in error["message"]) == ("version_retired", True)
    assert act_with_state(client, None)["version"] == 2, "a new episode starts"


def test_a_token_of_a_republished_version_is_rejected(client: TestClient, tmp_path: Path) -> None:
    elsewhere = build_everything(Storage.at(tmp_path / "elsewhere"))
    elsewhere.close()
    with replica(elsewhere.storage) as other:
        state = act_with_state(other, None)["state"]
    error = rejected(client, {"observation": [1], "state": state}, model="memory")
    assert (error["code"], "a different version 1 of memory.shared" in error["message"]) == ("invalid_state", True)


def test_a_policy_without_state_accepts_no_token(read_only_client: TestClient) -> None:
    assert "state" not in act(read_only_client, observation=BOARD, state=None)
    assert "state" not in act(read_only_client, observations=[BOARD], state=[None])
    state = act_with_state(read_only_client, None)["state"]
    assert rejected(read_only_client, {"observation": BOARD, "state": state})["code"] == "invalid_state"


def test_the_number_of_query_parameters_is_limited(read_only_client: TestClient) -> None:
    error = rejected(read_only_client, {"observation": BOARD}, params=[("a", "1")] * 17)
    assert (error["code"], "more than 16" in error["message"]) == ("invalid_input", True)


def test_a_large_request_without_a_champion_is_answered_if_a_token_names_the_version(registry: Registry) -> None:
    """Its episode began with a version by number."""
    settings = QUICK.model_copy(update={"max_body": 2**20, "max_batch": 1024})
    register(registry, "unpromoted", {"shared": MEMORY})
    publish(registry, "unpromoted", {"shared": counting()}, "run")
    with replica(registry.storage, settings) as client:
        path, rows = "/v1/policies/unpromoted/action", 512
        body = {"observations": [[0]] * rows}
        begun = client.post(f"{path}?version=1", json=body)
        assert begun.status_code == 200, begun.text
        content = json.dumps(body | {"state": begun.json()["state"]}).encode()
        assert len(content) > LARGE_BODY
        assert client.post(path, content=content).status_code == 200
