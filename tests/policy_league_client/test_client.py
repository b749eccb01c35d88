"""Both clients against a real replica: requests, responses and errors are the same."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import AsyncMock

import numpy as np
import pytest

from league import errors
from league.policies.onnx import OnnxPolicy
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from policy_league_client import AsyncClient, Client, retries
from serve_app.access import api_keys
from serve_app.runtime import uvicorn_websocket
from tests.support.clients.actions import board_arrays, boards, key_position
from tests.support.clients.sync_and_async import Connect
from tests.support.policies.graphs import masked_mlp
from tests.support.servers.streaming import Listening, listening
from tests.support.waiting import until

BOARD = {"observation": np.zeros((6, 7, 2), np.int8), "action_mask": np.ones(7, np.int8)}


def test_both_clients_have_the_same_signatures() -> None:
    def arguments(function: Callable[..., Any]) -> list[str]:
        return [str(parameter) for parameter in inspect.signature(function).parameters.values()]

    for name, method in inspect.getmembers(Client, inspect.isfunction):
        if not name.startswith("_"):
            assert arguments(getattr(AsyncClient, name)) == arguments(method), name
    assert arguments(AsyncClient) == arguments(Client)


def test_a_batch_gets_the_actions_of_the_graph(connect: Connect, url: str) -> None:
    batch = board_arrays(boards(8))
    expected = OnnxPolicy(masked_mlp(seed=1)).act(batch).actions.tolist()
    frame = np.random.default_rng(0).integers(0, 256, (84, 84, 4), dtype=np.uint8)
    for encoding in ("base64", "lists", "png"):
        client = connect(url, encoding=encoding)
        answer = client.act_batch("board@2", batch)
        assert (answer.actions, answer.version, answer.replica, answer.state) == (expected, 2, "replica-1", None)
        alone = [client.act("board@2", {name: array[row] for name, array in batch.items()}) for row in range(8)]
        assert [(one.action, type(one.action), one.sha256) for one in alone] == [
            (action, int, answer.sha256) for action in expected
        ]
        np.testing.assert_allclose(client.act("pistons", frame).action, [frame.mean() / 1000], rtol=1e-5)


def test_actions_have_the_types_of_the_environment(connect: Connect, url: str) -> None:
    client = connect(url)
    vector = client.act("vector", np.array([0.5, -2 / 3], np.float32)).action
    assert (vector.dtype, vector.shape) == (np.float32, (2,))
    assert type(client.act("choice", np.int64(2)).action) is int
    nested = {"mode": np.int64(2), "sense": {"speed": np.array([1.0, 2.0], np.float32)}}
    assert client.act("nested", nested).action == 1
    assert client.act("nested", {"mode": 2, "sense": {"speed": [-1.0, -2.0]}}).action == 0


def test_another_dtype_is_rejected_as_base64_and_converted_as_lists(connect: Connect, url: str) -> None:
    observation = np.array([0.5, -0.25])
    with pytest.raises(errors.ObservationError, match="float64"):
        connect(url).act("vector", observation)
    assert connect(url, encoding="lists").act("vector", observation).action.shape == (2,)
    swapped = np.array([0.5, -0.25], ">f4")
    np.testing.assert_array_equal(connect(url).act("vector", swapped).action, swapped)


def test_the_seed_of_an_answer_reproduces_it(connect: Connect, url: str) -> None:
    client = connect(url)
    first = client.act("board", BOARD, explore=True)
    assert first.seed is not None
    assert client.act("board", BOARD, explore=True, seed=first.seed).action == first.action
    actions = {client.act("board", BOARD, explore=True).action for _ in range(30)}
    assert len(actions) > 1, "each call has its own seed"
    batch = board_arrays(boards(5))
    again = [client.act_batch("board", batch, explore=True, seed=[1, 2, 3, 4, 5]).actions for _ in range(2)]
    assert again[0] == again[1]
    assert client.act("board", BOARD, explore=False).seed is None
    assert client.act("board", BOARD).seed is not None, "the league may sample by default"


def test_probabilities_are_returned_on_request(connect: Connect, url: str) -> None:
    client = connect(url)
    mask = np.array([1, 0, 1, 1, 1, 1, 1], np.int8)
    answer = client.act("board", BOARD | {"action_mask": mask}, probabilities=True)
    assert answer.probabilities.shape == (7,)
    assert answer.probabilities[1] == 0
    np.testing.assert_allclose(answer.probabilities.sum(), 1)
    assert answer.action == answer.probabilities.argmax()
    gaussian = client.act_batch("vector", np.zeros((3, 2), np.float32), probabilities=True).probabilities
    assert [(one["mean"].shape, one["std"].shape) for one in gaussian] == [((2,), (2,))] * 3
    assert client.act("board", BOARD).probabilities is None


def test_recurrent_state_is_a_token_for_the_next_call(connect: Connect, url: str) -> None:
    client = connect(url)
    observation = np.ones(1, np.float32)
    first = client.act("memory", observation)
    second = client.act("memory", observation, state=first.state)
    assert isinstance(first.state, str)
    assert second.state != first.state
    batch = client.act_batch("memory", np.ones((2, 1), np.float32), state=[first.state, None])
    assert batch.state == [second.state, first.state]
    assert batch.response(0).action == second.action


def test_errors_are_raised_by_their_code(connect: Connect, url: str, subtests: pytest.Subtests) -> None:
    cases: tuple[tuple[str, Any, type[Exception]], ...] = (
        ("nobody", BOARD, errors.UnknownLeague),
        ("board@99", BOARD, errors.UnknownVersion),
        ("headless", BOARD, errors.NotReady),
        ("Board", BOARD, errors.InvalidReference),
        ("board@", BOARD, errors.InvalidReference),
        ("board", np.zeros((6, 7, 2), np.int8), errors.ObservationError),
        ("board", BOARD | {"observation": np.array(["a"])}, errors.InvalidInput),
        ("board", BOARD | {"observation": object()}, errors.InvalidInput),
        ("choice", np.zeros((600, 1024), np.int8), errors.BodyTooLarge),
    )
    client = connect(url, retry_deadline=0.2)
    for model, observation, expected in cases:
        with subtests.test(model, expected=expected):
            with pytest.raises(expected) as raised:
                client.act(model, observation)
            assert type(raised.value) is expected
    unequal = {"observation": np.zeros((2, 1)), "action_mask": np.zeros((3, 1))}
    for batch in ([], unequal, "abc", 7):
        with pytest.raises(errors.InvalidInput):
            client.act_batch("board", batch)


def test_leagues_versions_and_aliases_are_listed(connect: Connect, url: str) -> None:
    client = connect(url)
    assert {league["league"]: league["champion"] for league in client.leagues()}["board"] == 1
    assert [version["version"] for version in client.versions("board")] == [1, 2, 3]
    assert client.aliases("board") == {"champion": 1}
    assert client.league("duo")["agents"] == {"agent_left": "left", "agent_right": "right"}
    assert client.is_live()
    client.wait_until_ready()


def test_a_server_that_cannot_be_reached_is_reported(connect: Connect) -> None:
    client = connect("http://127.0.0.1:9", retry_deadline=0.05)
    assert not client.is_live()
    with pytest.raises(errors.NotReady, match=r"was not ready within 0\.1 s"):
        client.wait_until_ready(0.1)
    with pytest.raises(errors.RemoteError, match=r"127\.0\.0\.1:9/v1/leagues cannot be reached"):
        client.leagues()


def test_invalid_client_options_are_rejected(connect: Connect) -> None:
    for options in ({"timeout": 0.0}, {"key": "é"}, {"caller": "é"}):
        with pytest.raises(errors.InvalidInput):
            connect(**options)
    for address in ("127.0.0.1:8000", "ftp://host", "", "http://", "http://a:b"):
        with pytest.raises(errors.InvalidInput, match="address of a server"):
            connect(address)


def test_keys_are_limited_to_their_scopes(
    connect: Connect, registry: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, token = registry.keys.create("player", ["act"])
    with listening(registry.storage) as listener:
        with pytest.raises(errors.Unauthenticated):
            connect(listener.url).act("board", BOARD)
        monkeypatch.setenv("LEAGUE_API_KEY", token)
        client = connect(listener.url)
        client.wait_until_ready()
        assert client.act("board", BOARD).version == 1
        with pytest.raises(errors.Forbidden, match="requires the scope promote; the key player has act"):
            client.promote("board@2")
        with client.stream("board") as stream:
            assert stream.act(BOARD) == client.act("board", BOARD).action
            registry.keys.revoke("player")
            with pytest.raises(errors.Unauthenticated, match="revoked"):
                until(lambda: stream.act(BOARD) is None)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time of clients and of rate limits, which passes only while a client waits."""
    times = [0.0]

    def sleep(seconds: float) -> None:
        times.append(times[-1] + seconds)

    for part in ("client", "stream"):
        monkeypatch.setattr(f"policy_league_client._sync.{part}.sleep", sleep)
        monkeypatch.setattr(f"policy_league_client._async.{part}.async_sleep", AsyncMock(side_effect=sleep))
    monkeypatch.setattr(retries, "monotonic", lambda: times[-1])
    monkeypatch.setattr(uvicorn_websocket, "LONGEST_PAUSE", 0.01)
    monkeypatch.setattr(api_keys, "TokenBucket", partial(api_keys.TokenBucket, clock=lambda: times[-1]))
    return times


def test_a_rate_limited_request_is_retried_until_the_deadline(
    connect: Connect, registry: Registry, clock: list[float]
) -> None:
    _, token = registry.keys.create("slow", ["act"], rate=0.5)
    with listening(registry.storage) as listener:
        without_retries = connect(listener.url, key=token, retry_deadline=0.0)
        action = without_retries.act("board", BOARD).action
        with pytest.raises(errors.RateLimited) as raised:
            without_retries.act("board", BOARD)
        assert raised.value.wait == 2
        patient = connect(listener.url, key=token, retry_deadline=30.0)
        assert patient.act("board", BOARD).action == action
        assert clock == [0, 2]
        with patient.stream("board") as stream:
            assert [stream.act(BOARD) for _ in range(2)] == [action] * 2


def test_promotions_are_applied_once_and_awaited_on_all_replicas(connect: Connect, registry: Registry) -> None:
    _, token = registry.keys.create("operator", ["act", "read", "promote"])
    with listening(registry.storage) as listener:
        client = connect(listener.url, key=token)
        moved = client.promote("board@2", expected=1, reason="better", wait=240)
        assert (moved.version, moved.previous, moved.actor, moved.reason) == (2, 1, "operator", "better")
        assert client.act("board", BOARD).version == 2
        with pytest.raises(errors.AliasMoved):
            client.promote("board@3", expected=1)
        same = [client.promote("board@3", idempotency_key="once") for _ in range(2)]
        assert same[0] == same[1]
        with pytest.raises(errors.KeyReused):
            client.promote("board@1", idempotency_key="once")
        back = client.rollback("board", expected=3, wait=240)
        assert (back.kind, back.version) == ("rollback", 2)
        assert client.promote("board@1", alias="candidate", expected=None, wait=240).alias == "candidate"
        assert client.act("board@candidate", BOARD).version == 1
        with pytest.raises(errors.InvalidInput, match="expected a version number"):
            client.promote("board@candidate")


def test_evaluations_are_started_once_listed_and_stopped(connect: Connect, registry: Registry) -> None:
    _, token = registry.keys.create("operator", ["read", "evaluate"])
    with listening(registry.storage) as listener:
        client = connect(listener.url, key=token)
        same = [client.evaluate("board", contestants=["board@champion"], idempotency_key="once") for _ in range(2)]
        assert same[0] == same[1]
        number = same[0]["evaluation"]
        assert (same[0]["state"], same[0]["request"]["contestants"]) == ("queued", ["board@1"])
        other = client.evaluate("board", blocks=2, reason="try", wait=0.1)
        assert (other["state"], other["reason"]) == ("queued", "try")
        assert [row["evaluation"] for row in client.evaluations("board")] == [other["evaluation"], number]
        assert [row["evaluation"] for row in client.evaluations("board", before=other["evaluation"])] == [number]
        assert client.stop_evaluation("board", number)["state"] == "stopped"
        assert client.evaluation("board", number)["stopped_by"] == "operator"
        with pytest.raises(errors.UnknownVersion):
            client.evaluate("board", contestants=["board@9"])
        with pytest.raises(errors.Forbidden, match="requires a key with the scope promote"):
            client.evaluate("board", kind="nightly")
        with pytest.raises(errors.UnknownEvaluation):
            client.evaluation("board", 99)


def test_a_caller_keeps_its_version_during_a_canary(connect: Connect, registry: Registry, listener: Listening) -> None:
    setting = registry.traffic.set("board", canary=Portion(2, 0.5), actor="test", reason="test")
    until(lambda: [one.traffic for one in registry.replicas.acknowledgements("board")] == [setting.id])
    expected = {f"player-{i}": 2 if key_position("board", b"player-%d" % i) < 0.5 else 1 for i in range(20)}
    assert set(expected.values()) == {1, 2}
    for caller, version in expected.items():
        client = connect(listener.url, caller=caller)
        assert client.act("board", BOARD).version == version
        with client.stream("board", follow=True) as stream:
            stream.act(BOARD)
            assert stream.version == version
    assert connect(listener.url).act("board", BOARD).version == 1
