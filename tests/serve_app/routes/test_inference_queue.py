"""Requests for inference that arrive with their body are answered as the application answers them."""

import asyncio
import gc
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.load.http import JSON
from league.errors import GraphTimeout, Overloaded
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.settings import Storage
from serve_app.access.load_shedding import Backlog
from serve_app.app import Replica
from serve_app.live_versions.policies import LoadedPolicy
from serve_app.routes import inference_queue
from serve_app.routes.inference_queue import InferenceQueue
from serve_app.runtime.uvicorn_http import HttpProtocol
from tests.support.clients.actions import BOARD, INVALID, boards
from tests.support.leagues.served_leagues import everything, promote
from tests.support.servers.replicas import QUICK, READ_ONLY
from tests.support.servers.shadows import set_shadow, wait_for
from tests.support.servers.two_paths import (
    Connections,
    binary_boards,
    changing,
    exchange,
    infer,
    receive,
    request,
    together,
)
from tests.support.waiting import until

VECTOR = {"observation": [0.25, -0.5]}
NESTED = {"observation": {"mode": 2, "sense": {"speed": [1.5, 2]}}}
INLINE = 10.0
"""A busy machine may measure that policies are too slow for the fast path."""
AT_ONCE = QUICK.model_copy(update={"inline": INLINE})


@pytest.fixture(scope="module")
def replica(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Connections]:
    storage = Storage.at(tmp_path_factory.mktemp("plain") / "home")
    everything(storage).close()
    settings = READ_ONLY.model_copy(update={"inline": INLINE})
    with Connections(Replica(Registry.open(storage), settings, "replica-1")) as connections:
        until(lambda: connections.server.alias_slots.champion("board") is not None)
        yield connections


SENSES = {
    "observation.mode": np.array([2, 1]),
    "observation.sense.speed": np.array([[1.5, 2], [-1, 0.25]], np.float32),
}


PLAIN: dict[str, bytes] = {
    "one": request({"observation": BOARD}),
    "a batch": request({"observations": boards(8)}),
    "a policy": request({"observation": BOARD}, "board.shared"),
    "one of two policies": request({"observation": BOARD}, "duo.left"),
    "a vector": request(VECTOR, "vector"),
    "nested": request(NESTED, "nested"),
    "binary, one": infer(binary_boards(1), outputs=["action"]),
    "binary, a batch": infer(binary_boards(8)),
    "binary, all outputs": infer(binary_boards(1), outputs=["action_dist_inputs", "action"]),
    "binary, a version": infer(binary_boards(1), "board/versions/1"),
    "binary, an alias": infer(binary_boards(1), "board.shared/versions/champion"),
    "binary, nested": infer(dict(reversed(SENSES.items())), "nested"),
    "binary, an encoding": infer(binary_boards(1), more={"Accept-Encoding": "gzip"}),
}


def test_plain_requests_take_the_fast_path(replica: Connections, subtests: pytest.Subtests) -> None:
    for name, data in PLAIN.items():
        with subtests.test(name):
            for _ in range(2):  # what the JSON says is known the second time
                count = len(replica.answered)
                answer = exchange(replica.fast, data)
                assert len(replica.answered) == count + 1
                assert answer.startswith(b"HTTP/1.1 200 OK\r\n")
                assert answer == exchange(replica.general, data)


OTHERS: dict[str, bytes] = {  # besides those that are generated
    "explore": request({"observation": BOARD, "explore": True, "seed": 3}),
    "probabilities": request({"observation": BOARD, "probabilities": True}),
    "a version": request({"observation": BOARD}, query="?version=2"),
    "an encoded path": request({"observation": BOARD}, model="bo%61rd"),
    "an unknown league": request({"observation": BOARD}, model="nobody"),
    "an unknown policy": request({"observation": BOARD}, model="board.nobody"),
    "no champion": request({"observation": BOARD}, model="empty"),
    "no model": request({"observation": BOARD}, model=""),
    "a slash": request({"observation": BOARD}, model="board/shared"),
    "recurrent": request({"observation": [0.5]}, model="memory"),
    "another media type": request({"observation": BOARD}, headers={"Content-Type": "application/xml"}),
    "a charset": request({"observation": BOARD}, headers={"Content-Type": "application/json; charset=utf-8"}),
    "an encoding": request({"observation": BOARD}, headers=JSON | {"Content-Encoding": "gzip"}),
    "a timeout": request({"observation": BOARD}, headers=JSON | {"X-Request-Timeout-Ms": "1000"}),
    "a wrong timeout": request({"observation": BOARD}, headers=JSON | {"X-Request-Timeout-Ms": "soon"}),
    "a foreign page": request({"observation": BOARD}, headers=JSON | {"Origin": "http://example.org"}),
    "a foreign host": request({"observation": BOARD}).replace(b"Host: localhost", b"Host: example.org"),
    "a wrong key": request({"observation": BOARD}, headers=JSON | {"X-API-Key": "plk_wrong"}),
    "too many": request({"observations": boards(9)}),
    "large": request({"observation": BOARD, "seed": [1] * 20_000}),
    "too large": request({"observation": BOARD, "seed": [1] * 40_000}),
    "illegal": request({"observation": BOARD | {"action_mask": [0] * 7}}),
    "binary, a response to compress": infer(
        {"observation": np.zeros((8, 6, 7, 2), np.int8), "action_mask": np.ones((8, 7), np.int8)},
        outputs=["action", "action_dist_inputs"],
        more={"Accept-Encoding": "gzip"},
    ).replace(b'"binary_data":true', b'"binary_data":null'),
    "binary, illegal": infer({**binary_boards(1), "action_mask": np.zeros((1, 7), np.int8)}),
    "binary, an input is missing": infer({"observation": binary_boards(1)["observation"]}),
    "binary, unequal rows": infer(binary_boards(2) | {"action_mask": np.ones((1, 7), np.int8)}),
    "binary, a version that is not in memory": infer(binary_boards(1), "board/versions/2"),
    "binary, an unknown version": infer(binary_boards(1), "board/versions/9"),
    "binary, no version": infer(binary_boards(1), "board/versions/"),
    "binary, an encoding": infer(binary_boards(1), more={"Content-Encoding": "gzip"}),
    "a duplicate key": request(b'{"observation": [1, 0], "observation": [0, 1]}', model="vector"),
    **{f"invalid: {name}": request(body, model) for name, (model, body, *_) in INVALID.items()},
}


def test_other_requests_get_the_same_answer(replica: Connections, subtests: pytest.Subtests) -> None:
    for name, data in OTHERS.items():
        with subtests.test(name):
            assert exchange(replica.fast, data) == exchange(replica.general, data)


@pytest.fixture
def sizes(replica: Connections, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of rows of each run on the event loop."""
    sizes = list[int]()
    act = LoadedPolicy.act_inline

    def record(policy: LoadedPolicy, *arguments: Any) -> Any:
        actions = act(policy, *arguments)
        sizes.append(len(actions.actions))
        return actions

    monkeypatch.setattr(LoadedPolicy, "act_inline", record)
    return sizes


def test_requests_of_one_turn_are_one_batch(replica: Connections, sizes: list[int]) -> None:
    bodies = [{"observation": board} for board in boards(5)] + [{"observations": boards(3)}]
    answers = together(replica, replica.fast, [request(body) for body in bodies])
    assert sizes == [8]
    assert answers == [exchange(replica.general, request(body)) for body in bodies]


def test_probabilities_of_one_turn_are_one_batch(replica: Connections, sizes: list[int]) -> None:
    requests = [request({"observation": board, "probabilities": True}) for board in boards(5)]
    answers = together(replica, replica.fast, requests)
    assert sizes == [5]
    for answer, data in zip(answers, requests, strict=True):
        one, other = (json.loads(text.partition(b"\r\n\r\n")[2]) for text in (answer, exchange(replica.general, data)))
        assert one.pop("probabilities") == pytest.approx(other.pop("probabilities"), abs=1e-5)
        assert one == other


def test_some_requests_run_alone(replica: Connections, sizes: list[int], tmp_path: Path) -> None:
    booleans = BOARD | {"action_mask": [True] * 7}
    together(replica, replica.fast, [request({"observation": BOARD, "seed": 1})] * 3)
    assert sizes == [1, 1, 1]
    together(replica, replica.fast, [request({"observation": booleans})] * 2)
    assert sizes == [1] * 5
    settings = AT_ONCE.model_copy(update={"unbatched": ["board", "duo.left"]})
    with changing(Storage.at(tmp_path / "home"), settings) as (excepting, _):
        sizes.clear()
        for model in ("board", "board.shared", "duo.left", "duo.right"):
            together(excepting, excepting.fast, [request({"observation": BOARD}, model)] * 2)
    assert sizes == [1] * 6 + [2]


def test_a_queue_is_answered_over_several_turns_the_oldest_first(
    replica: Connections, monkeypatch: pytest.MonkeyPatch
) -> None:
    queued, take_turn = [], InferenceQueue._take_turn

    def record(plain: InferenceQueue, loop: asyncio.AbstractEventLoop) -> None:
        take_turn(plain, loop)
        queued.append(replica.server.access.backlog.queued)

    monkeypatch.setattr(InferenceQueue, "_take_turn", record)
    monkeypatch.setattr(inference_queue, "SLICE", 0)
    monkeypatch.setattr(inference_queue, "GROUP", 3)
    bodies = [{"observation": board} for board in boards(10)]
    count = len(replica.answered)
    answers = together(replica, replica.fast, [request(body) for body in bodies])
    until(lambda: queued == [7, 4, 1, 0])
    assert len(replica.answered) == count + 10
    assert answers == [exchange(replica.general, request(body)) for body in bodies]


def test_a_refused_request_gets_the_same_answer_without_a_task(
    replica: Connections, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: Backlog) -> None:
        raise Overloaded("too many requests are waiting in this replica")

    monkeypatch.setattr(Backlog, "admit", refuse)
    monkeypatch.setattr(HttpProtocol, "pass_on", lambda _: pytest.fail("the application is asked"))
    data = request({"observation": BOARD})
    with socket.create_connection(replica.fast) as connection:  # which remains open
        for _ in range(2):
            connection.sendall(data)
            answer = receive(connection)
            assert answer.startswith(b"HTTP/1.1 429")
            assert b"retry-after: 1\r\n" in answer
            assert answer == exchange(replica.general, data)


def test_a_flawed_request_does_not_affect_others_of_its_turn(replica: Connections) -> None:
    bodies: list[Any] = [{"observation": board} for board in boards(3)]
    bodies.insert(1, {"observation": BOARD | {"action_mask": [0] * 7}})
    bodies.insert(2, {"observation": BOARD | {"action_mask": [1, 1, 1, 1.5, 1, 1, 1]}})
    answers = together(replica, replica.fast, [request(body) for body in bodies])
    assert [answer[9:12] for answer in answers] == [b"200", b"400", b"400", b"200", b"200"]
    assert answers == [exchange(replica.general, request(body)) for body in bodies]


def test_a_slow_policy_occupies_the_event_loop_once(replica: Connections, monkeypatch: pytest.MonkeyPatch) -> None:
    champion = replica.server.alias_slots.champion("board")
    assert champion is not None
    policy = champion.policy(None)
    runs = 0

    def take_long(policy: Any, *_: Any) -> Any:
        nonlocal runs
        runs += 1
        policy.inline_rows = 0
        raise GraphTimeout("too slow")

    monkeypatch.setattr(policy, "inline_rows", 8)
    monkeypatch.setattr(type(policy), "act_inline", take_long)
    bodies = [{"observations": boards(4)} for _ in range(5)]
    answers = together(replica, replica.fast, [request(body) for body in bodies])
    monkeypatch.undo()
    assert runs == 1
    assert answers == [exchange(replica.general, request(body)) for body in bodies]


def test_a_bug_is_answered_and_affects_no_other_request(replica: Connections, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("a bug")

    requests = [request({"observation": BOARD}), request(VECTOR, "vector"), infer(binary_boards(1))]
    expected = [exchange(replica.general, data) for data in requests]
    for owner, function in (
        (replica.server.models, "find"),
        (type(replica.server.serving), "act"),
        (replica.server.metrics, "count_request"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, function, fail)
            answers = together(replica, replica.fast, requests)
        assert [answer[9:12] for answer in answers] == [b"500"] * 3
        assert together(replica, replica.fast, requests) == expected
    with monkeypatch.context() as patch:
        patch.setattr(replica.server.access, "admission", fail)
        assert exchange(replica.fast, requests[0]).startswith(b"HTTP/1.1 500")
    champion = replica.server.alias_slots.champion("vector")
    assert champion is not None
    with monkeypatch.context() as patch:
        patch.setattr(champion.policy(None).inline_graph, "act", fail)
        answers = together(replica, replica.fast, requests)
    assert [answer[9:12] for answer in answers] == [b"200", b"500", b"200"]


def test_a_connection_that_cannot_be_answered_affects_no_other(
    replica: Connections, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every request of a turn is answered, although writing the first response fails."""
    requests = [request({"observation": board}) for board in boards(5)]
    expected = [exchange(replica.general, data) for data in requests]
    answer, failures = HttpProtocol.answer, [RuntimeError("a bug")]

    def fail_once(protocol: HttpProtocol, *rest: Any) -> None:
        if failures:
            protocol.transport.close()
            raise failures.pop()
        answer(protocol, *rest)

    with socket.create_connection(replica.fast) as connection:
        exchange(replica.fast, requests[0])
        with monkeypatch.context() as patch:
            patch.setattr(HttpProtocol, "answer", fail_once)
            connection.sendall(request({"observation": BOARD, "seed": 1}))
            assert connection.recv(1) == b""
            assert together(replica, replica.fast, requests) == expected


def test_pipelined_requests_are_answered_in_order(replica: Connections) -> None:
    requests = [request({"observation": BOARD}), OTHERS["probabilities"], request(VECTOR, "vector"), OTHERS["illegal"]]
    for parts in (requests, requests[::-1]):
        with socket.create_connection(replica.fast) as connection:
            connection.sendall(b"".join(parts))
            answers = receive(connection, len(parts))
        assert answers == b"".join(exchange(replica.general, part) for part in parts)


def test_a_body_in_pieces(replica: Connections) -> None:
    data = request({"observations": boards(8)})
    expected = exchange(replica.general, data)
    for piece in (50, 200, 1000, len(data) - 1):
        with socket.create_connection(replica.fast) as connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.sendall(data[:piece])
            exchange(replica.fast, request(VECTOR, "vector"))  # the server has read the first piece
            connection.sendall(data[piece:])
            assert receive(connection) == expected


def test_an_idle_connection_keeps_no_body(replica: Connections) -> None:
    for data in (request({"observations": boards(8)}), OTHERS["probabilities"]):
        with socket.create_connection(replica.fast) as connection:
            connection.sendall(data)
            receive(connection)
            # Other connections of this process may have one of these ports, and closed ones, to which recorded requests
            # refer, both.
            ports = connection.getsockname(), connection.getpeername()
            protocols = [item for item in gc.get_objects() if issubclass(type(item), HttpProtocol)]
            same = (item for item in protocols if (item.client, item.server) == ports)
            (protocol,) = (item for item in same if item in item.connections)
            assert protocol.body == b""


def test_a_client_that_is_gone(replica: Connections) -> None:
    data = request({"observation": BOARD})
    with replica.busy(), socket.create_connection(replica.fast) as connection:
        connection.sendall(data)
    assert exchange(replica.fast, data) == exchange(replica.general, data)


def test_keys_and_their_limits_hold(tmp_path: Path) -> None:
    with changing(Storage.at(tmp_path / "home"), AT_ONCE) as (replica, registry):
        _, token = registry.keys.create("game", ["act"], only_leagues=["board"], rate=0.1)
        board, keyed = {"observation": BOARD}, JSON | {"X-API-Key": token}
        until(lambda: exchange(replica.fast, request(board)).startswith(b"HTTP/1.1 401"))
        assert exchange(replica.fast, request(board)) == exchange(replica.general, request(board))
        foreign = request(VECTOR, "vector", keyed)
        assert exchange(replica.fast, foreign).startswith(b"HTTP/1.1 403")
        count = len(replica.answered)
        answers = together(replica, replica.fast, [request(board, headers=keyed) for _ in range(6)])
        statuses = [answer[9:12] for answer in answers]
        assert set(statuses) == {b"200", b"429"}
        assert len(replica.answered) == count + 6
        assert b"x-league-key-accepted: 1" in next(answer for answer in answers if answer[9:12] == b"200")


def test_shadows_canaries_and_mixtures(tmp_path: Path) -> None:
    def requests() -> list[bytes]:
        return [request({"observation": BOARD}, headers=JSON | {"X-League-Key": name}) for name in "abcdefgh"]

    with changing(Storage.at(tmp_path / "home"), AT_ONCE) as (replica, registry):
        set_shadow(registry)
        until(lambda: "board" in replica.server.traffic.shadows)
        until(lambda: replica.server.alias_slots.get("board", "2") is not None)
        for board in boards(4):
            exchange(replica.fast, request({"observation": board}))
        assert len(replica.answered) == 4
        counts = wait_for(registry, lambda counts: counts.requests + counts.dropped == 4)
        assert counts.dropped == 0
        assert replica.server.metrics.totals()["action"][0] == 4
        registry.traffic.set("board", canary=Portion(2, 0.5), shadow=None, actor="test", reason="test")
        until(lambda: "board" in replica.server.traffic.canaries)
        for data in requests():
            assert exchange(replica.fast, data) == exchange(replica.general, data)
        assert len(replica.answered) == 4 + 8
        registry.traffic.set("board", canary=None, actor="test", reason="test")
        promote(registry, "board", registry.publisher.publish_mixture("board", {1: 0.5, 2: 0.5}).number)
        until(lambda: (served := replica.server.alias_slots.champion("board")) is not None and served.members)
        until(lambda: "board" not in replica.server.traffic.canaries)
        answers = [exchange(replica.fast, data) for data in requests()]
        assert answers == [exchange(replica.general, data) for data in requests()]
        assert len(set(answers)) == 2
        assert len(replica.answered) == 4 + 16


def test_a_full_replica_refuses(tmp_path: Path) -> None:
    with changing(Storage.at(tmp_path / "home"), AT_ONCE.model_copy(update={"max_in_flight": 1})) as (replica, _):
        replica.server.serving.in_flight["action"] = 1
        data = request({"observation": BOARD})
        assert exchange(replica.fast, data).startswith(b"HTTP/1.1 429")
        assert exchange(replica.fast, data) == exchange(replica.general, data)


def test_the_application_answers_pages_of_other_origins(storage: Storage) -> None:
    headers = [(b"content-length", b"2"), (b"content-type", b"application/json")]
    for origins, takes in (([], True), (["https://game.example"], False)):
        settings = QUICK.model_copy(update={"cors_origins": origins})
        plain = Replica(Registry.open(storage), settings, "replica-1").inference_queue
        assert plain is not None
        assert plain.takes(b"/v1/policies/board/action", headers)
        assert plain.takes(b"/v1/policies/board/action", [*headers, (b"origin", b"https://game.example")]) is takes
