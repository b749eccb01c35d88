"""What the action route takes and answers beside plain observations: base64, pictures, probabilities, tokens."""

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
from tests.league.policies.graphs import counting, masked_mlp
from tests.serve_app.conftest import QUICK, replica
from tests.serve_app.inference_protocol.leagues import DTYPES, FRAME, every_kind
from tests.serve_app.leagues import promote, publish
from tests.serve_app.test_action import BOARD, act, boards, refused
from tests.serve_app.test_encoded import png


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A replica that serves every dtype, and pictures; nothing is changed in it."""
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


def picture(pixels: np.ndarray) -> dict[str, str]:
    return {"png": b64encode(png(pixels)).decode()}


def test_base64_gets_the_actions_of_the_same_lists(unchanging: TestClient) -> None:
    batch = boards(8)
    expected = act(unchanging, observations=batch)["actions"]
    assert act(unchanging, observations=[b64_board(board) for board in batch])["actions"] == expected
    mixed = [b64_board(board) if row % 2 else board for row, board in enumerate(batch)]
    assert act(unchanging, observations=mixed)["actions"] == expected
    half = {"observation": batch[0]["observation"], "action_mask": b64_board(batch[0])["action_mask"]}
    assert act(unchanging, observation=half)["action"] == expected[0]


def test_base64_of_every_dtype(kinds: TestClient) -> None:
    random = np.random.default_rng(0)
    arrays = {dtype: random.integers(0, 2, (2, 3)).astype(dtype) for dtype in DTYPES}
    lists = {dtype: array.tolist() for dtype, array in arrays.items()}
    encoded = {dtype: b64(array, dtype=dtype, shape=[2, 3]) for dtype, array in arrays.items()}
    assert act(kinds, "kinds", observation=encoded)["action"] == act(kinds, "kinds", observation=lists)["action"]


def test_what_is_told_of_base64_must_be_so(unchanging: TestClient) -> None:
    mask = b64(np.ones(7, np.int8))
    for leaf, words in (
        (b64(np.ones(7, np.float32)), "holds 28 bytes, expected 7"),
        (mask | {"dtype": "float32"}, "nothing is converted"),
        (mask | {"shape": [1, 7]}, "has shape [1, 7], expected [7]"),
    ):
        error = refused(unchanging, {"observation": BOARD | {"action_mask": leaf}})
        assert (error["code"], words in error["message"]) == ("invalid_observation", True), error
    zeros = b64(np.zeros(7, np.int8))
    assert refused(unchanging, {"observation": BOARD | {"action_mask": zeros}})["code"] == "illegal_mask"
    infinite = b64(np.array([np.inf, 0], np.float32))
    assert "infinity" in refused(unchanging, {"observation": infinite}, model="vector")["message"]
    beyond = {"mode": b64(np.int64(9)), "sense": {"speed": [1, 1]}}
    assert "between 1 and 3" in refused(unchanging, {"observation": beyond}, model="nested")["message"]


def test_strings_beside_base64_are_still_refused(unchanging: TestClient) -> None:
    error = refused(unchanging, {"observation": b64_board(BOARD) | {"observation": [["0"]]}})
    assert "stands where a number is expected" in error["message"]


def test_a_picture_gets_the_action_of_its_pixels(kinds: TestClient) -> None:
    for pixels in frames(3):
        expected = act(kinds, "pistons", observation=pixels.tolist())["action"]
        assert act(kinds, "pistons", observation=picture(pixels))["action"] == expected
        assert act(kinds, "pistons", observation=b64(pixels))["action"] == expected
        stack = {"png": [picture(pixels[..., [i]])["png"] for i in range(4)]}
        assert act(kinds, "pistons", observation=stack)["action"] == expected
    batch = [picture(pixels) for pixels in frames(3)]
    alone = [act(kinds, "pistons", observation=each)["action"] for each in batch]
    assert act(kinds, "pistons", observations=batch)["actions"] == alone


def test_a_small_body_does_not_become_a_large_batch(kinds: TestClient) -> None:
    black = picture(np.zeros(FRAME, np.uint8))
    body = {"observations": [black] * 2500}  # 70 MB of pixels
    assert refused(kinds, body, 413, "pistons")["code"] == "body_too_large"


def test_pictures_of_something_else_are_refused(kinds: TestClient) -> None:
    error = refused(kinds, {"observation": picture(np.zeros((84, 84, 3), np.uint8))}, model="pistons")
    assert (error["code"], "3 values" in error["message"]) == ("invalid_observation", True)
    error = refused(kinds, {"observation": picture(np.zeros((2, 2), np.uint8))}, model="vector")
    assert "no picture" in error["message"]


def softmax(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    return weights / weights.sum(axis=1, keepdims=True)


def test_probabilities_are_told_on_request(unchanging: TestClient) -> None:
    policy, batch = OnnxPolicy(masked_mlp(seed=0)), boards(8)
    arrays = {name: np.array([board[name] for board in batch], np.int8) for name in BOARD}
    inputs = policy.distribution(arrays).dist_inputs
    assert inputs is not None
    reply = act(unchanging, observations=batch, probabilities=True)
    assert reply["probabilities"] == [pytest.approx(row) for row in softmax(inputs)]
    assert [int(np.argmax(row)) for row in reply["probabilities"]] == reply["actions"]
    for board, row in zip(batch, reply["probabilities"], strict=True):
        assert [share == 0 for share in row] == [not allowed for allowed in board["action_mask"]]
    one = act(unchanging, observation=batch[0], probabilities=True, explore=True, seed=3)
    assert one["probabilities"] == pytest.approx(reply["probabilities"][0])
    assert one["action"] == act(unchanging, observation=batch[0], explore=True, seed=3)["action"]
    assert "probabilities" not in act(unchanging, observation=batch[0], probabilities=False)


def test_a_continuous_policy_tells_mean_and_deviation(unchanging: TestClient) -> None:
    """Its graph answers the observation as the mean, and as the logarithm of the deviation."""
    reply = act(unchanging, "vector", observation=[0.5, -1.0], probabilities=True)
    assert reply["probabilities"] == {
        "mean": pytest.approx([0.5, -1.0]),
        "std": pytest.approx([np.exp(0.5), np.exp(-1)]),
    }


def remember(client: TestClient, state: Any, version: Any = None, **body: Any) -> dict[str, Any]:
    body = body or {"observation": [1]}
    return act(client, "memory", version, state=state, **body)


def test_an_episode_goes_on_with_its_token(unchanging: TestClient) -> None:
    state, actions = None, []
    for _ in range(4):
        reply = remember(unchanging, state)
        state = reply["state"]
        assert isinstance(state, str)
        actions.append(reply["action"])
    assert actions == [0, 0, 1, 1], "more than two ones so far"
    again = remember(unchanging, state)
    assert again["action"] == 1
    assert remember(unchanging, state) == again, "a token is no counter: a call may be repeated"


def test_episodes_of_a_batch_have_a_token_each(unchanging: TestClient) -> None:
    tokens = remember(unchanging, None, observations=[[1], [2], [5]])["state"]
    assert len(set(tokens)) == 3
    reply = remember(unchanging, [tokens[2], None, tokens[0]], observations=[[0], [0], [2]])
    assert reply["actions"] == [1, 0, 1]
    assert remember(unchanging, [None, None], observations=[[1], [3]])["actions"] == [0, 1]
    assert isinstance(remember(unchanging, tokens[1])["state"], str), "a token of a batch goes on alone"


def test_a_token_holds_while_the_champion_changes(client: TestClient, registry: Registry) -> None:
    state = remember(client, None)["state"]
    publish(registry, "memory", {"shared": counting()}, "run/2")
    promote(registry, "memory", 2)
    while remember(client, None)["version"] != 2:
        pass
    for expected in (0, 1, 1):
        reply = remember(client, state)
        state = reply["state"]
        assert (reply["version"], reply["action"]) == (1, expected)
    assert remember(client, state, "champion")["version"] == 1, "an alias chose when the episode began"
    assert remember(client, state, 1)["version"] == 1
    error = refused(client, {"observation": [1], "state": state}, model="memory", params={"version": "2"})
    assert (error["code"], "version 2 is asked for" in error["message"]) == ("invalid_state", True)
    fresh = remember(client, None)["state"]
    error = refused(client, {"observations": [[1], [1]], "state": [state, fresh]}, model="memory")
    assert (error["code"], "several versions" in error["message"]) == ("invalid_state", True)


def test_a_pinned_version_answers_across_promotions(client: TestClient, registry: Registry) -> None:
    for champion in (2, 3, 1):
        promote(registry, "board", champion)
        while act(client, observation=BOARD)["version"] != champion:
            pass
        assert act(client, version=1, observation=BOARD)["version"] == 1


def test_a_retired_version_says_so(client: TestClient, registry: Registry) -> None:
    state = remember(client, None)["state"]
    for number in range(2, 2 + QUICK.cached_versions + 1):  # so that it is not in memory any more
        publish(registry, "memory", {"shared": counting()}, f"run/{number}")
        remember(client, None, number)
    promote(registry, "memory", 2)
    while remember(client, None)["version"] != 2:
        pass
    remember(client, None, 3)
    shutil.rmtree(registry.artifacts.path("memory", 1))
    for number in range(3, 3 + QUICK.cached_versions):
        remember(client, None, number)
    for body, params in (({"observation": [1], "state": state}, {}), ({"observation": [1]}, {"version": "1"})):
        error = refused(client, body, 410, "memory", params=params)
        assert (error["code"], "memory@1 was retired" in error["message"]) == ("version_retired", True)
    assert remember(client, None)["version"] == 2, "a new episode begins"


@pytest.mark.parametrize("change", [lambda text: text[:-4], lambda text: "B" + text[1:], lambda text: text + "AAAA"])
def test_a_damaged_token_is_refused(unchanging: TestClient, change: Any) -> None:
    state = remember(unchanging, None)["state"]
    error = refused(unchanging, {"observation": [1], "state": change(state)}, model="memory")
    assert (error["code"], "no token" in error["message"]) == ("invalid_state", True)


def test_a_token_of_another_policy_is_refused(unchanging: TestClient) -> None:
    state = remember(unchanging, None)["state"]
    for model, observation in (("board", BOARD), ("empty", BOARD), ("duo.left", BOARD)):
        error = refused(unchanging, {"observation": observation, "state": state}, model=model)
        assert (error["code"], f"not of {model}" in error["message"]) == ("invalid_state", True)


def test_a_token_of_a_version_that_was_published_otherwise_is_refused(client: TestClient, tmp_path: Path) -> None:
    elsewhere = every_kind(Storage.at(tmp_path / "elsewhere"))
    elsewhere.close()
    with replica(elsewhere.storage) as other:
        state = remember(other, None)["state"]
    error = refused(client, {"observation": [1], "state": state}, model="memory")
    assert (error["code"], "another version 1 of memory.shared" in error["message"]) == ("invalid_state", True)


def test_a_policy_without_memory_takes_no_state(unchanging: TestClient) -> None:
    assert "state" not in act(unchanging, observation=BOARD, state=None)
    assert "state" not in act(unchanging, observations=[BOARD], state=[None])
    state = remember(unchanging, None)["state"]
    assert refused(unchanging, {"observation": BOARD, "state": state})["code"] == "invalid_state"


def test_more_parameters_than_anybody_means(unchanging: TestClient) -> None:
    error = refused(unchanging, {"observation": BOARD}, params=[("a", "1")] * 17)
    assert (error["code"], "more than 16" in error["message"]) == ("invalid_input", True)
