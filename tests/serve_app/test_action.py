"""The action route: responses, encodings, options, state tokens and errors; sampled actions, and endless graphs."""

import asyncio
import json
import shutil
import threading
from base64 import b64encode
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from starlette.testclient import TestClient

from league.errors import ArtifactCorrupt
from league.policies import onnx
from league.policies.graph_runs import run_graph
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.app import Replica
from serve_app.codecs.request_limits import LARGE_BODY
from serve_app.live_versions import version_cache
from serve_app.live_versions.policies import ActionOptions, ActionSelections
from tests.support.clients.actions import BOARD, INVALID, act, b64, board_arrays, boards, inference, rejected
from tests.support.leagues.protocol_leagues import DTYPES, FRAME, every_kind
from tests.support.leagues.served_leagues import BOARD as SPACES
from tests.support.leagues.served_leagues import MEMORY, build_everything, promote, publish, register
from tests.support.pictures import png
from tests.support.policies.graphs import ENDLESS, counting, endless_mlp, masked_mlp
from tests.support.servers.exposition import value
from tests.support.servers.replicas import LOCALHOST, QUICK, replica
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.waiting import until

ACTION = "/v1/policies/board/action"


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A replica with all dtypes and images, for tests that do not change its data."""
    storage = Storage.at(tmp_path_factory.mktemp("kinds"))
    every_kind(storage).close()
    with replica(storage, QUICK.model_copy(update={"max_body": 2**20, "max_batch": 3000})) as client:
        yield client


def b64_board(board: dict[str, Any]) -> dict[str, Any]:
    return {name: b64(np.array(value, np.int8)) for name, value in board.items()}


def image(pixels: np.ndarray) -> dict[str, str]:
    return {"png": b64encode(png(pixels)).decode()}


def test_observations_get_the_actions_of_the_graph(read_only_client: TestClient, storage: Storage) -> None:
    """Alone and in a batch, as lists and in base64, of each version."""
    registry, batch = Registry.open(storage), boards(8)
    for version in (1, 2, 3):
        expected = OnnxPolicy(masked_mlp(seed=version - 1)).act(board_arrays(batch)).actions.tolist()
        assert len(set(expected)) > 1
        source = {"model": "board", "version": version, "sha256": registry.versions.get("board", version).sha256}
        encoded = [b64_board(board) for board in batch]
        mixed = [b64_board(board) if row % 2 else board for row, board in enumerate(batch)]
        for observations in (batch, encoded, mixed):
            reply = act(read_only_client, version=version, observations=observations)
            assert reply == {"actions": expected} | source
        for board, action in zip(batch, expected, strict=True):
            half = board | {"action_mask": b64_board(board)["action_mask"]}
            for observation in (board, half):
                reply = act(read_only_client, version=version, observation=observation)
                assert reply == {"action": action} | source
    registry.close()
    reply = read_only_client.post(ACTION, json={"observations": batch})
    assert reply.json()["version"] == 1, "the champion"
    assert reply.headers["x-league-replica"] == "replica-1"


def test_aliases_and_numbers_select_versions(client: TestClient, registry: Registry) -> None:
    registry.aliases.set("board", "candidate", 3, expected=None, actor="test", reason="test")
    assert act(client, version="candidate", observation=BOARD)["version"] == 3
    assert act(client, version="champion", observation=BOARD)["version"] == 1
    for champion in (2, 3, 1):
        promote(registry, "board", champion)
        until(lambda champion=champion: act(client, observation=BOARD)["version"] == champion)
        assert act(client, version=1, observation=BOARD)["version"] == 1
    assert act(client, "headless", version=1, observation=BOARD)["version"] == 1, "it has no champion"


def test_all_spaces_and_dtypes(read_only_client: TestClient, kinds: TestClient) -> None:
    assert act(read_only_client, "duo.left", observation=BOARD)["model"] == "duo.left"
    assert act(read_only_client, "vector", observation=[0.5, -1])["action"] == [0.5, -1.0]
    for speed, action in ((1, 1), (-1, 0)):
        nested = {"mode": 2, "sense": {"speed": [0.5, speed]}}
        assert act(read_only_client, "nested", observations=[nested])["actions"] == [action]
    random = np.random.default_rng(0)
    arrays = {dtype: random.integers(0, 2, (2, 3)).astype(dtype) for dtype in DTYPES}
    lists = {dtype: array.tolist() for dtype, array in arrays.items()}
    encoded = {dtype: b64(array, dtype=dtype, shape=[2, 3]) for dtype, array in arrays.items()}
    assert act(kinds, "kinds", observation=encoded)["action"] == act(kinds, "kinds", observation=lists)["action"]


def test_an_image_gets_the_action_of_its_pixels(kinds: TestClient) -> None:
    frames = np.random.default_rng(5).integers(0, 256, (3, *FRAME), dtype=np.uint8)
    expected = [act(kinds, "pistons", observation=pixels.tolist())["action"] for pixels in frames]
    assert act(kinds, "pistons", observations=[image(pixels) for pixels in frames])["actions"] == expected
    for pixels, action in zip(frames, expected, strict=True):
        stack = {"png": [image(pixels[..., [channel]])["png"] for channel in range(4)]}
        for observation in (image(pixels), b64(pixels), stack):
            assert act(kinds, "pistons", observation=observation)["action"] == action
    black = image(np.zeros(FRAME, np.uint8))
    body = {"observations": [black] * 2500}  # 70 MB of pixels
    assert rejected(kinds, body, 413, "pistons")["code"] == "body_too_large"


def softmax(logits: np.ndarray) -> np.ndarray:
    weights = np.exp(logits - logits.max(axis=1, keepdims=True), dtype=np.float64)
    return weights / weights.sum(axis=1, keepdims=True)


def test_probabilities_are_returned_on_request(read_only_client: TestClient) -> None:
    batch = boards(8)
    inputs = OnnxPolicy(masked_mlp(seed=0)).distribution(board_arrays(batch)).dist_inputs
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
    # The graph of `vector` outputs the observation as the mean and as the log standard deviation.
    gaussian = act(read_only_client, "vector", observation=[0.5, -1.0], probabilities=True)["probabilities"]
    assert gaussian == {"mean": pytest.approx([0.5, -1.0]), "std": pytest.approx([np.exp(0.5), np.exp(-1)])}


def test_exploring_with_a_seed_is_reproducible(read_only_client: TestClient) -> None:
    (board,) = boards(1)

    def drawn(seeds: Any, model: str = "board", observation: Any = board) -> list[Any]:
        body = {"observation": observation, "explore": True}
        return [act(read_only_client, model, **body, **seed)["action"] for seed in seeds]

    seeds = [{"seed": seed} for seed in range(60)]
    draws = drawn(seeds)
    assert draws == drawn(seeds)
    assert set(draws) == {action for action, allowed in enumerate(board["action_mask"]) if allowed}
    assert draws[:8] == act(read_only_client, observations=[board] * 8, explore=True, seed=list(range(8)))["actions"]
    assert len(set(drawn([{}] * 60))) > 1, "without a seed"
    long = act(read_only_client, observations=[BOARD] * 8, explore=True, seed=7)["actions"]
    assert act(read_only_client, observations=[BOARD] * 3, explore=True, seed=7)["actions"] == long[:3]
    assert len(set(long)) > 1, "draws of a batch depend on the row"
    first, same, other = drawn([{"seed": 5}, {"seed": 5}, {"seed": 6}], "vector", [0, 0])
    assert first == same != other


def test_invalid_requests_are_rejected_by_the_route_and_by_streams(
    read_only_client: TestClient, subtests: pytest.Subtests
) -> None:
    with ExitStack() as stack:
        streams = {
            model: stack.enter_context(read_only_client.websocket_connect(f"/v1/policies/{model}/stream"))
            for model in ("board", "vector", "nested")
        }
        for name, (model, body, code, message) in INVALID.items():
            with subtests.test(name):
                error = rejected(read_only_client, body, model=model)
                assert (error["code"], message in error["message"]) == (code, True), error
                if name != "bytes":  # of no text
                    streams[model].send_text(body.decode() if isinstance(body, bytes) else json.dumps(body))
                    answer = streams[model].receive_json()
                    assert (answer["code"], answer["status"], message in answer["message"]) == (code, 400, True)
        streams["board"].send_json({"observation": BOARD})
        assert streams["board"].receive_json()["version"] == 1, "the stream goes on"


UNKNOWN = (
    ("/v1/policies/nobody/action", 404, "unknown_league"),
    ("/v1/policies/Board/action", 400, "invalid_reference"),
    ("/v1/policies/board..x/action", 400, "invalid_reference"),
    ("/v1/policies/board@1/action", 400, "invalid_reference"),
    ("/v1/policies/board.other/action", 404, "unknown_policy"),
    ("/v1/policies/duo/action", 404, "unknown_policy"),
    ("/v1/policies/duo.middle/action", 404, "unknown_policy"),
    ("/v1/policies/empty/action", 503, "not_ready"),
    ("/v1/policies/headless/action", 503, "not_ready"),
    (f"{ACTION}?version=99", 404, "unknown_version"),
    (f"{ACTION}?version=0", 400, "invalid_reference"),
    (f"{ACTION}?version=99999999999999999999", 400, "invalid_reference"),
    (f"{ACTION}?version=rival", 404, "unknown_alias"),
    (f"{ACTION}?version=", 400, "invalid_reference"),
    (f"{ACTION}?version=%00", 400, "invalid_reference"),
    (f"{ACTION}?{'&'.join(['a=1'] * 17)}", 400, "invalid_input"),
    ("/v1/policies/board/act", 404, "unknown_path"),
    ("/v1/policies//action", 404, "unknown_path"),
    ("/", 405, "method_not_allowed"),
)


def test_unknown_resources_are_reported(read_only_client: TestClient, subtests: pytest.Subtests) -> None:
    for path, status, code in UNKNOWN:
        with subtests.test(path):
            reply = read_only_client.post(path, json={"observation": BOARD})
            assert (reply.status_code, reply.json()["code"]) == (status, code)
            assert ("retry-after" in reply.headers) == (status == 503)


def test_other_methods_and_media_types_are_rejected(read_only_client: TestClient) -> None:
    for method in ("GET", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS"):
        reply = read_only_client.request(method, ACTION)
        assert (reply.status_code, reply.headers["allow"]) == (405, "POST")
        assert method == "HEAD" or reply.json()["message"] == f"{method} is not allowed for {ACTION}: use POST"
    reply = read_only_client.delete("/v1/leagues/board/traffic")
    assert (reply.status_code, reply.headers["allow"]) == (405, "GET, HEAD, POST")
    assert reply.json()["message"].endswith("use GET or POST")
    content = json.dumps({"observation": BOARD})
    for media_type in ("image/png", "multipart/form-data; boundary=x", "text/html", "nonsense"):
        error = rejected(read_only_client, content.encode(), 415, headers={"content-type": media_type})
        assert error["code"] == "unsupported_media_type"
    for media_type in ("application/json; charset=utf-8", "application/x-www-form-urlencoded"):
        reply = read_only_client.post(ACTION, content=content, headers={"content-type": media_type})
        assert reply.status_code == 200, media_type


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("path", "document", "api"),
    [
        (ACTION, {"observation": BOARD}, "action"),
        ("/v2/models/vector/infer", inference({"observation": np.zeros((1, 2), np.float32)}), "infer"),
    ],
)
async def test_the_number_of_concurrent_requests_is_limited(
    registry: Registry, path: str, document: dict[str, Any], api: str
) -> None:
    server = Replica(registry, QUICK.model_copy(update={"max_in_flight": 2}), "replica-1")
    resume = asyncio.Event()

    async def body() -> AsyncIterator[bytes]:
        await resume.wait()
        yield json.dumps(document).encode()

    transport = httpx.ASGITransport(server.application())
    async with server.watcher.watching(), httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
        slow = [asyncio.create_task(client.post(path, content=body())) for _ in range(2)]
        while server.serving.in_flight[api] < 2:
            await asyncio.sleep(0)
        reply = await client.post(path, json=document)
        assert (reply.status_code, reply.headers["retry-after"]) == (429, "1")
        assert (await client.get("/v1/leagues")).status_code == 200
        resume.set()
        assert [(await request).status_code for request in slow] == [200, 200]
        assert (await client.post(path, json=document)).status_code == 200


@pytest.mark.anyio
async def test_the_number_of_other_concurrent_requests_is_limited(registry: Registry) -> None:
    server = Replica(registry, QUICK.model_copy(update={"max_in_flight": 2}), "replica-1")
    resume = threading.Event()
    transport = httpx.ASGITransport(server.application())
    async with server.watcher.watching(), httpx.AsyncClient(transport=transport, base_url=LOCALHOST) as client:
        blocked = [asyncio.create_task(server.models.in_registry_thread(lambda _: resume.wait(60))) for _ in range(4)]
        slow = [asyncio.create_task(client.get("/v1/leagues")) for _ in range(3)]
        refused, _ = await asyncio.wait(slow, return_when=asyncio.FIRST_COMPLETED)
        (reply,) = [request.result() for request in refused]
        assert (reply.status_code, reply.json()["code"]) == (429, "overloaded")
        assert (await client.get("/v1/health/live")).status_code == 200
        assert (await client.post(ACTION, json={"observation": BOARD})).status_code == 200
        resume.set()
        await asyncio.gather(*blocked)
        assert sorted([(await request).status_code for request in slow]) == [200, 200, 429]


def act_with_state(client: TestClient, state: Any, version: Any = None, **body: Any) -> dict[str, Any]:
    return act(client, "memory", version, state=state, **(body or {"observation": [1]}))


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


def test_a_policy_without_state_accepts_none(read_only_client: TestClient) -> None:
    assert "state" not in act(read_only_client, observation=BOARD, state=None)
    assert "state" not in act(read_only_client, observations=[BOARD], state=[None])
    for state in (act_with_state(read_only_client, None)["state"], {"state_in_0": [[1]]}):
        assert rejected(read_only_client, {"observation": BOARD, "state": state})["code"] == "invalid_state"


def test_a_token_is_valid_after_a_promotion(client: TestClient, registry: Registry) -> None:
    state = act_with_state(client, None)["state"]
    publish(registry, "memory", {"shared": counting()}, "run/2")
    promote(registry, "memory", 2)
    until(lambda: act_with_state(client, None)["version"] == 2)
    for expected in (0, 1, 1):
        reply = act_with_state(client, state)
        state = reply["state"]
        assert (reply["version"], reply["action"]) == (1, expected)
    for version in ("champion", 1):
        assert act_with_state(client, state, version)["version"] == 1, "the version with which the episode started"
    fresh = act_with_state(client, None)["state"]
    for body, params, message in (
        ({"observation": [1], "state": state}, {"version": "2"}, "the request is for version 2"),
        ({"observations": [[1], [1]], "state": [state, fresh]}, {}, "several versions"),
    ):
        error = rejected(client, body, model="memory", params=params)
        assert (error["code"], message in error["message"]) == ("invalid_state", True)


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


def test_a_token_of_a_republished_version_is_rejected(read_only_client: TestClient, tmp_path: Path) -> None:
    elsewhere = build_everything(Storage.at(tmp_path / "elsewhere"))
    elsewhere.close()
    with replica(elsewhere.storage) as other:
        state = act_with_state(other, None)["state"]
    error = rejected(read_only_client, {"observation": [1], "state": state}, model="memory")
    assert (error["code"], "a different version 1 of memory.shared" in error["message"]) == ("invalid_state", True)


def test_a_large_request_without_a_champion_is_answered_if_a_token_names_the_version(registry: Registry) -> None:
    """Its episode began with a version by number."""
    settings = QUICK.model_copy(update={"max_body": 2**20, "max_batch": 1024})
    register(registry, "unpromoted", {"shared": MEMORY})
    publish(registry, "unpromoted", {"shared": counting()}, "run")
    with replica(registry.storage, settings) as client:
        body = {"observations": [[0]] * 512}
        body["state"] = act(client, "unpromoted", 1, **body)["state"]
        assert len(json.dumps(body)) > LARGE_BODY
        act(client, "unpromoted", **body)


def actions(client: TestClient, **body: Any) -> list[int]:
    """The actions of 32 requests with different seeds."""
    return [
        action
        for first in range(0, 32, 8)
        for action in act(client, observations=[BOARD] * 8, seed=list(range(first, first + 8)), **body)["actions"]
    ]


@pytest.fixture
def sampled(registry: Registry) -> Iterator[TestClient]:
    """A replica of a registry in which version 4 of `board` has the graph of version 1, and version 5 is of DQN."""
    register(registry, "board", {"shared": SPACES}, actions="sampled")
    publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/copy")
    publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/dqn", algorithm="dqn")
    with replica(registry.storage) as client:
        yield client


def test_requests_sample_unless_they_refuse(sampled: TestClient) -> None:
    drawn = actions(sampled)
    assert len(set(drawn)) > 1
    assert drawn == actions(sampled, explore=True)
    assert len(set(actions(sampled, explore=False))) == 1
    assert len(set(actions(sampled, version=2))) > 1, "each version samples"
    assert sampled.get("/v1/leagues/board").json()["actions"] == "sampled"


def test_versions_without_a_distribution_stay_greedy(sampled: TestClient) -> None:
    greedy = act(sampled, version=1, observation=BOARD, explore=False)["action"]
    assert set(actions(sampled, version=5)) == set(actions(sampled, version=5, explore=True)) == {greedy}
    for options in ({}, {"explore": True}, {"explore": False}):
        answer = act(sampled, version=5, observation=BOARD, probabilities=True, **options)
        assert answer["probabilities"] == [float(action == greedy) for action in range(7)]


@pytest.mark.parametrize(("candidate", "is_equal"), [(4, True), (2, False)])
def test_a_shadow_samples_with_the_random_numbers_of_the_champion(
    sampled: TestClient, registry: Registry, candidate: int, is_equal: bool
) -> None:
    set_shadow(registry, candidate)
    observations = boards(40)
    for start in range(0, 40, 8):
        act(sampled, observations=observations[start : start + 8], **({"explore": False} if start == 8 else {}))
    counts = wait_for(registry, lambda one: one.requests == 5, candidate=candidate)
    assert counts.observations == 40
    assert (counts.agreed == 40) == is_equal


def test_loaded_versions_follow_the_league(registry: Registry) -> None:
    """A candidate that is loaded after the change is compared with the champion by the same kind of actions."""
    publish(registry, "board", {"shared": masked_mlp(seed=0)}, "run/copy")
    with replica(registry.storage) as client:
        assert [len(set(actions(client, version=version))) for version in (1, 2)] == [1, 1]
        register(registry, "board", {"shared": SPACES}, actions="sampled")
        until(lambda: len(set(actions(client))) > 1)
        assert len(set(actions(client, version=2))) > 1
        set_shadow(registry, 4)
        act(client, observations=boards(8))
        counts = wait_for(registry, lambda one: one.requests == 1, candidate=4)
        assert (counts.observations, counts.agreed) == (8, 8)
        register(registry, "board", {"shared": SPACES}, actions="greedy")
        until(lambda: len(set(actions(client))) == 1)


FULL = BOARD | {"observation": np.ones((6, 7, 2), int).tolist()}


@pytest.fixture
def _impatience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Limits of runs that do not end are a 600th. All others need no limit, however busy the machine is."""

    def run_impatiently(session: Any, outputs: list[str], feed: dict[str, NDArray], seconds: float) -> Any:
        is_endless = feed.get("observation", np.zeros(1)).sum() == ENDLESS
        return run_graph(session, outputs, feed, seconds / 600 if is_endless else seconds)

    monkeypatch.setattr(onnx, "run_graph", run_impatiently)


@pytest.mark.usefixtures("_impatience")
def test_a_request_gets_an_error_and_others_are_answered(registry: Registry) -> None:
    """In all protocols, on the event loop and in a thread."""
    version = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    path = f"/v1/policies/board/action?version={version}"
    with replica(registry.storage) as client:
        assert act(client, version=version, observation=BOARD)["version"] == version
        for _ in range(2):
            reply = client.post(path, json={"observation": FULL})
            assert (reply.status_code, reply.json()["code"]) == (504, "graph_timeout")
            assert "a run of the graph did not finish within 0.1 s" in reply.json()["message"]
            assert act(client, observation=boards(1)[0])["version"] == 1
        assert (
            client.post(f"/v2/models/board/versions/{version}/infer", json=inference(board_arrays([FULL]))).status_code
            == 504
        )
        with client.websocket_connect(f"/v1/policies/board/stream?version={version}") as stream:
            stream.send_json({"observation": FULL})
            assert stream.receive_json()["code"] == "graph_timeout"
            stream.send_json({"observation": BOARD})
            assert stream.receive_json()["version"] == version
        assert act(client, version=version, observation=BOARD)["version"] == version
        until(lambda: value(client, "league_errors_total", code="graph_timeout") == 4)


def test_a_version_that_does_not_end_is_not_loaded(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.support.policies.graphs.ENDLESS", 0)
    version = publish(registry, "board", {"shared": endless_mlp()}, "run/endless").number
    with pytest.raises(ArtifactCorrupt, match=r"policy shared of board@4 does not run: .* within 0.2 s"):
        version_cache.load(registry, "board", version, 0.001, ActionSelections(), timeout=0.2)


@pytest.mark.anyio
async def test_a_slow_policy_leaves_threads_to_others(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its callers wait for each other, not all others for them."""
    version = version_cache.load(registry, "board", 1, 0.0, ActionSelections())
    policy, ended = version.policy("shared"), threading.Event()
    policy.inline_rows = 0

    def wait(*_: Any) -> Actions:
        ended.wait()
        return Actions(np.zeros(1))

    monkeypatch.setattr(type(policy), "_act", wait)
    runs = [asyncio.create_task(policy.act(policy.reader.zeros(1), ActionOptions())) for _ in range(64)]
    try:
        await asyncio.sleep(0)
        assert await asyncio.wait_for(asyncio.to_thread(lambda: "answered"), timeout=60) == "answered"
        assert not any(run.done() for run in runs)
    finally:
        ended.set()
    await asyncio.gather(*runs)
