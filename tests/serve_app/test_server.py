"""A real server with Ray Serve, HAProxy and two replicas, under load, promotions and faults, in all protocols."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from ipaddress import ip_address
from itertools import product
from pathlib import Path
from typing import Any

import grpc
import httpx
import numpy as np
import psutil
import pytest
import tritonclient.grpc
from filelock import FileLock
from ray.serve._private.constants import SERVE_HTTP_REQUEST_ID_HEADER
from tritonclient.utils import InferenceServerException
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from evaluation.documents import EvaluationReport
from evaluation.matches.tournament import evaluate
from league.registry.registry import Registry
from league.registry.storage.rows import Portion
from league.results.ledger import Ledger
from league.results.records import Match
from league.settings import Storage
from policy_league_client import Client, Stream
from policy_league_client.stream_protocol import StreamProtocol
from serve_app.inference_protocol.statistics import REPORT
from serve_app.runtime import haproxy
from serve_app.runtime.launch import running
from tests.support.clients.actions import BOARD
from tests.support.clients.event_streams import listen
from tests.support.clients.protocol_observations import observations, policy_of
from tests.support.clients.triton import FORMS, Triton, assert_same
from tests.support.ipv6 import needs_ipv6
from tests.support.leagues import tictactoe
from tests.support.leagues.served_leagues import promote
from tests.support.servers.protocol_servers import Address
from tests.support.servers.scaling import scale
from tests.support.servers.under_load import ACTION, RayServer, load, processes, serving
from tests.support.waiting import until

pytestmark = pytest.mark.slow  # a real server takes all cores

EVALUATIONS = "/v1/leagues/tictactoe/evaluations"


@pytest.fixture(scope="module")
def served(ray_server: RayServer) -> Registry:
    return ray_server.registry


@pytest.fixture(scope="module")
def url(ray_server: RayServer) -> str:
    return ray_server.url


def test_all_replicas_answer_with_their_name_and_report_for_all(url: str, served: Registry) -> None:
    promote(served, "board", 1)
    until(lambda: serving(served, 1) == 2)
    with httpx.Client(base_url=url) as client:

        def answering() -> set[str]:
            return {client.post(ACTION, json={"observation": BOARD}).headers["x-league-replica"] for _ in range(16)}

        def listed() -> set[str]:
            return {row["replica"] for row in client.get("/v1/leagues/board").json()["replicas"]}

        def measured() -> set[str]:
            return set(
                re.findall(r'^league_request_seconds_count{.*replica="(.*?)"', client.get("/metrics").text, re.M)
            )

        # One that another test has killed stays in the list for some seconds.
        until(lambda: len(replicas := answering()) == 2 and replicas == listed() <= measured())
        assert client.get("/v1/health/ready").status_code == 200


def test_replicas_have_the_priority_of_the_server(served: Registry) -> None:
    """Ray lowers that of its workers by default: busy processes of the machine would take the CPU from replicas."""
    until(lambda: len(processes(served.storage, "PolicyServer")) == 2)  # one of them may be replaced
    priorities = {os.getpriority(os.PRIO_PROCESS, pid) for pid in processes(served.storage, "PolicyServer")}
    assert priorities == {os.getpriority(os.PRIO_PROCESS, 0)}


@pytest.mark.e2e
@pytest.mark.e2e
def test_actions_bypass_ray_serve_and_its_protocols(url: str) -> None:
    with httpx.Client(base_url=url, trust_env=False) as client:

        def act() -> httpx.Response:
            return client.post(ACTION, json={"observation": BOARD})

        # Until HAProxy knows the replicas, Ray Serve's proxy answers, without our protocols.
        until(lambda: "x-request-id" not in act().headers, seconds=120)
        assert client.get("/-/routes").json() == {"/": "policy-league"}, "Ray Serve answers its own paths"
        assert SERVE_HTTP_REQUEST_ID_HEADER == "x-request-id", "Ray Serve marks the responses that it handles"
        for method, path, body in (
            ("POST", ACTION, {"observation": BOARD}),
            ("POST", "/v2/models/board/infer", {"inputs": []}),
            ("GET", "/v1/leagues", None),
            ("GET", "/v1/health/live", None),
        ):
            direct = client.request(method, path, json=body)
            assert direct.headers["content-type"] == "application/json"
            assert "x-request-id" not in direct.headers, f"{path} does not bypass Ray Serve: see serve_bypass.py"
    address = url.replace("http://", "ws://") + "/v1/policies/board/stream"
    with connect(address, proxy=None) as stream:  # offers compression, which uvicorn's own protocol accepts
        assert stream.response is not None
        assert "sec-websocket-extensions" not in stream.response.headers, "uvicorn_websocket.py is not installed"
        stream.send(json.dumps({"observation": BOARD}))
        assert "action" in json.loads(stream.recv(20))


@pytest.mark.e2e
def test_all_processes_of_a_local_server_listen_on_loopback(served: Registry) -> None:
    # Of Ray, its agents, replicas and HAProxy, which may be starting again.
    until(lambda: len({name for name, _ in listeners(served.storage)}) > 5)
    sockets = listeners(served.storage)
    addresses = {ip_address(address.removeprefix("::ffff:")) for _, address in sockets}
    assert [address for address in addresses if not address.is_loopback] == [], sockets


def listeners(storage: Storage) -> set[tuple[str, str]]:
    """Process and address of each socket of a server that listens."""
    addresses = set()
    for pid in processes(storage, ""):
        with suppress(psutil.NoSuchProcess):
            process = psutil.Process(pid)
            sockets = process.net_connections("tcp")
            addresses |= {(process.name(), one.laddr.ip) for one in sockets if one.status == psutil.CONN_LISTEN}
    return addresses


def test_messages_to_ray_serve_itself_are_not_read(served: Registry) -> None:
    """A call that only starts is answered, by replicas and by Serve's fallback proxy."""
    ends = threading.Event()

    def never() -> Iterator[bytes]:
        ends.wait()
        yield b""

    until(lambda: len(grpc_ports(served)) == 3)
    try:
        for port, method in product(grpc_ports(served), ("ListApplications", "Healthz")):
            with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
                call = channel.stream_unary(f"/ray.serve.RayServeAPIService/{method}")
                assert isinstance(call(never(), timeout=60), bytes)
    finally:
        ends.set()


def grpc_ports(registry: Registry) -> set[str]:
    """The ports in the configuration of a server's HAProxy; none while it is being replaced."""
    for pid in processes(registry.storage, "haproxy.cfg"):
        with suppress(psutil.NoSuchProcess, FileNotFoundError):
            for argument in psutil.Process(pid).cmdline():
                if argument.endswith("haproxy.cfg"):
                    lines = Path(argument).read_text()
                    return set(re.findall(r"^ *server [^ ]* 127[.]0[.]0[.]1:(\d+) proto h2 check", lines, re.M))
    return set()


def versions_of(url: str) -> Callable[[], Callable[[], int]]:
    """Return callers, each with a key of its thread and a connection, whose calls return the version that acted."""

    def caller() -> Callable[[], int]:
        client = httpx.Client(base_url=url, headers={"x-league-key": f"caller-{threading.get_ident()}"})

        def call() -> int:
            reply = client.post(ACTION, json={"observation": BOARD})
            assert reply.status_code == 200, reply.text
            return int(reply.json()["version"])

        return call

    return caller


def test_traffic_can_be_moved_under_load(url: str, served: Registry) -> None:
    caller = versions_of(url)
    promote(served, "board", 1)
    with load(caller, callers=4) as calls:
        for share in (1.0, 0.0, 1.0):
            canary, shadow = Portion(2, share), Portion(3, 1.0)
            setting = served.traffic.set("board", canary=canary, shadow=shadow, actor="test", reason="test")
            served.changes.wait_for_traffic(setting, 30)
            assert caller()() == (2 if share else 1)
        off = served.traffic.set("board", canary=None, shadow=None, actor="test", reason="test")
        served.changes.wait_for_traffic(off, 30)
    assert calls.failures == []
    assert calls.versions.keys() == {1, 2}
    until(lambda: [(one.candidate, one.failed) for one in served.traffic.shadow_counts("board")] == [(3, 0)])


def test_mixtures_are_swapped_under_load_and_pinned_in_every_replica(url: str, served: Registry) -> None:
    promote(served, "board", 1)
    mixtures = [served.publisher.publish_mixture("board", shares) for shares in ({1: 0.3, 3: 0.7}, {2: 0.5, 3: 0.5})]
    # New connections, which reach any replica.
    with httpx.Client(base_url=url, headers={"connection": "close"}) as client, load(versions_of(url), 4) as calls:
        for row in mixtures * 2:
            promote(served, "board", row.number)
            served.changes.wait_for_alias(served.aliases.history("board")[0], 30)
            assert row.mixture is not None
            for number in range(20):
                member = row.mixture.version_of("board", f"episode-{number}".encode())
                reply = client.post(ACTION, json={"observation": BOARD}, headers={"x-league-key": f"episode-{number}"})
                assert reply.json()["version"] == member
        promote(served, "board", 1)
        served.changes.wait_for_alias(served.aliases.history("board")[0], 30)
    assert calls.failures == []
    assert calls.versions.keys() <= {1, 2, 3}


@pytest.mark.e2e
def test_promotions_under_load_lose_no_request(url: str, served: Registry) -> None:
    caller = versions_of(url)
    send_request = caller()
    promote(served, "board", 1)
    until(lambda: serving(served, 1) == 2)
    with load(caller, callers=8) as calls:
        for version in (2, 3, 1) * 4:
            promote(served, "board", version)
            until(lambda version=version: serving(served, version) == 2)
            assert {send_request() for _ in range(4)} == {version}, "a replica answers with the previous version"
    assert calls.failures == []
    assert calls.versions.keys() == {1, 2, 3}


@pytest.mark.e2e
def test_a_body_of_a_hundred_megabytes_is_rejected(url: str, served: Registry) -> None:
    size, part = 100 * 2**20, b" " * 2**16
    until(lambda: len(peaks(served.storage)) == 2)
    peaks_before = peaks(served.storage)
    with httpx.Client(base_url=url, headers={"content-type": "application/json"}) as client:
        for length in ({}, {"content-length": str(size)}):
            try:
                reply = client.post(ACTION, content=(part for _ in range(size // len(part))), headers=length)
            except httpx.WriteError:
                pytest.fail("the connection was cut before the answer could be read")
            assert (reply.status_code, reply.json()["code"]) == (413, "body_too_large")
            assert client.post(ACTION, json={"observation": BOARD}).status_code == 200
    growth = [peak - peaks_before[pid] for pid, peak in peaks(served.storage).items()]
    assert max(growth) < 20 * 2**20


def peaks(storage: Storage) -> dict[int, int]:
    """Process id of each replica → its peak resident size in bytes."""
    sizes = {}
    for pid in processes(storage, "PolicyServer"):
        with suppress(FileNotFoundError):
            (peak,) = re.findall(r"^VmHWM:\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.M)
            sizes[pid] = int(peak) * 1024
    return sizes


@pytest.mark.e2e
def test_our_client_survives_the_death_of_a_replica(url: str, served: Registry) -> None:
    victim = processes(served.storage, "PolicyServer")[0]

    def caller() -> Callable[[], int]:
        client = Client(url, retry_deadline=60.0)  # a busy machine may replace a replica slowly
        return lambda: client.act("board", BOARD).version

    with load(caller, callers=8) as result:
        until(lambda: result.versions.total() > 200)
        os.kill(victim, signal.SIGKILL)
        after = result.versions.total()
        until(lambda: result.versions.total() > after + 2000)
    assert result.failures == []
    until(lambda: len(set(processes(served.storage, "PolicyServer")) - {victim}) == 2)


@pytest.mark.e2e
def test_promotions_end_no_stream(url: str, served: Registry) -> None:
    promote(served, "board", 1)
    until(lambda: serving(served, 1) >= 2)
    with Client(url) as client, client.stream("board") as pinned, client.stream("board", follow=True) as following:
        for version in (2, 3, 1):
            pinned.act(BOARD)
            promote(served, "board", version)
            until(lambda version=version: serving(served, version) == 2)
            for stream in (pinned, following):
                stream.act(BOARD)
            assert (pinned.version, following.version) == (1, version)


def test_event_streams_outlast_the_timeouts_of_the_server(url: str, served: Registry) -> None:
    """HAProxy cuts a response without data for 5 s."""
    with listen(url) as stream:
        until(lambda: stream.lines.count(": keep-alive") >= 4)
        promote(served, "board", 2)
        until(lambda: stream.last["aliases"] == {"champion": 2})
        until(lambda: stream.last["serving"] == {"2": 2})
        assert not stream.is_over
    promote(served, "board", 1)
    until(lambda: serving(served, 1) >= 2)


def test_episodes_survive_a_draining_replica(ray_server: RayServer, served: Registry) -> None:
    """The observations are ones, and the third action is 1: without its state, a policy would answer 0.

    Event streams of that replica end, the others continue.
    """
    with Client(ray_server.url) as client, ExitStack() as stack:
        listeners = [stack.enter_context(listen(ray_server.url)) for _ in range(6)]
        streams = [stack.enter_context(client.stream("memory")) for _ in range(6)]
        for _ in range(2):
            assert [stream.act([1.0]) for stream in streams] == [0] * 6
        assert len(replicas(streams)) == 2
        with close_codes() as codes:
            scale(ray_server, 1)
            until(lambda: [stream.act([0.0]) for stream in streams] and len(replicas(streams)) == 1)
        assert codes
        assert set(codes) == {1012}
        assert [stream.act([1.0]) for stream in streams] == [1] * 6
        until(lambda: any(listener.is_over for listener in listeners))
        assert not all(listener.is_over for listener in listeners)
        scale(ray_server, 2)
    until(lambda: serving(served, 1) >= 2)


def replicas(streams: list[Stream]) -> set[str]:
    return {stream.last.replica for stream in streams if stream.last is not None}


@contextmanager
def close_codes() -> Iterator[list[int]]:
    """The codes with which servers close streams of our client while the context lasts."""
    codes: list[int] = []
    lost = StreamProtocol.connection_lost

    def record(self: StreamProtocol, error: Exception) -> Any:
        assert isinstance(error, ConnectionClosed), error
        codes.append(error.rcvd.code if error.rcvd is not None else 1006)
        return lost(self, error)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(StreamProtocol, "connection_lost", record)
        yield codes


@pytest.fixture(scope="module")
def evaluator(url: str, served: Registry) -> Iterator[httpx.Client]:
    """A client with a key that may play and start evaluations and nightly runs."""
    _, token = served.keys.create("night-owl", ["act", "read", "evaluate", "promote"])
    promote(served, "board", 1)
    served.changes.wait_for_alias(served.aliases.history("board")[0], 60)  # both replicas know the key, too
    with httpx.Client(base_url=url, headers={"x-api-key": token}, timeout=30) as client:
        yield client


def start(client: httpx.Client, **body: Any) -> str:
    """Start an evaluation; returns its path."""
    replies: list[httpx.Response] = []
    headers = {"idempotency-key": str(body)}

    def is_accepted() -> bool:
        replies.append(client.post(EVALUATIONS, json=body, headers=headers))
        return replies[-1].status_code == 202

    until(is_accepted)
    return replies[-1].headers["location"]


def wait_for_end(client: httpx.Client, path: str) -> dict[str, Any]:
    until(lambda: client.get(path).json()["state"] not in ("queued", "running"))
    return dict(client.get(path).json())


def evaluate_locally(directory: Path, blocks: int) -> tuple[EvaluationReport, list[Match]]:
    """The report and the matches of `league evaluate` for the same versions."""
    registry = Registry.open(Storage.at(directory))
    tictactoe.playable(registry)
    report = evaluate(tictactoe.LEAGUE, registry=registry, blocks=blocks)
    matches = Ledger(registry).matches(league=tictactoe.LEAGUE)
    registry.close()
    return report, matches


def test_a_killed_evaluation_continues_and_equals_league_evaluate(
    evaluator: httpx.Client, served: Registry, tmp_path: Path
) -> None:
    report, matches = evaluate_locally(tmp_path, blocks=150)

    def stored_matches() -> list[Match]:
        return Ledger(served).matches(league=tictactoe.LEAGUE, schedule=report.schedule)

    path = start(evaluator, blocks=150)
    until(lambda: Ledger(served).positions(report.schedule) if is_stored(served, report.schedule) else False)
    first = only_process(served.storage, "evaluation.service.evaluation_job")
    os.kill(first, signal.SIGKILL)
    left = stored_matches()
    assert 0 < len(left) < len(matches)
    assert left == matches[: len(left)]
    until(lambda: set(processes(served.storage, "evaluation.service.evaluation_job")) - {first})
    document = wait_for_end(evaluator, path)
    assert (document["state"], document["error"]) == ("done", None)
    assert document["result"] == report.to_json()
    assert (document["progress"]["played"], document["progress"]["of"]) == (len(matches), len(matches))
    assert stored_matches() == matches


def is_stored(registry: Registry, schedule: str) -> bool:
    return schedule in [row.id for row in Ledger(registry).schedules(tictactoe.LEAGUE)]


def test_an_evaluation_is_stopped_between_chunks(evaluator: httpx.Client, served: Registry) -> None:
    path = start(evaluator, blocks=20_000)
    until(lambda: evaluator.get(path).json()["progress"])
    assert evaluator.delete(path).json()["stopped_by"] == "night-owl"
    document = wait_for_end(evaluator, path)
    assert (document["state"], document["result"]) == ("stopped", None)
    assert 0 < document["progress"]["played"] < document["progress"]["of"]
    until(lambda: not processes(served.storage, "evaluation.service.evaluation_job"))


def test_a_concurrent_nightly_run_fails_and_the_next_one_promotes(evaluator: httpx.Client, served: Registry) -> None:
    locks = served.storage.home / "locks"
    locks.mkdir(exist_ok=True)
    with FileLock(locks / "nightly-tictactoe.lock"):
        rejected = wait_for_end(evaluator, start(evaluator, kind="nightly", reason="first"))
    assert (rejected["state"], rejected["error"]["code"]) == ("failed", "already_running")
    assert "nightly-tictactoe.lock" in rejected["error"]["message"]
    night = wait_for_end(evaluator, start(evaluator, kind="nightly", reason="second"))
    assert (night["state"], night["result"]["champion"]) == ("done", "tictactoe@2")
    assert served.aliases.current("tictactoe")["champion"] == 2


@pytest.mark.timeout(1200)
def test_the_evaluation_service_runs_only_while_it_is_needed(tmp_path: Path) -> None:
    registry = Registry.open(Storage.at(tmp_path))
    tictactoe.playable(registry)
    _, token = registry.keys.create("night-owl", ["act", "read", "evaluate"])

    def has_ended() -> bool:
        return registry.snapshots.stale() == [] and not processes(registry.storage, ":EvaluationService")

    with (
        running(registry.storage, replicas=1) as url,
        httpx.Client(base_url=url, headers={"x-api-key": token}, timeout=30) as client,
    ):
        until(lambda: processes(registry.storage, ":EvaluationService"))
        until(has_ended, seconds=500)
        assert wait_for_end(client, start(client, blocks=1))["state"] == "done"
        assert processes(registry.storage, ":EvaluationService")
        until(has_ended, seconds=500)


def retry_until_ready(send_request: Callable[[], httpx.Response]) -> httpx.Response:
    """The response of a request that may first time out."""
    replies: list[httpx.Response] = []
    until(lambda: replies.append(send_request()) or replies[-1].status_code != 503)
    assert all(reply.json()["code"] in ("not_ready", "no_evaluation_service") for reply in replies[:-1])
    assert all("retry-after" in reply.headers for reply in replies[:-1])
    assert replies[-1].status_code == 200, replies[-1].text
    return replies[-1]


def test_a_game_survives_the_death_of_any_process(evaluator: httpx.Client, served: Registry) -> None:
    body: dict[str, Any] = {"opponent": "tictactoe@2", "agent": "player_1", "chances": True, "actions": []}

    def move() -> dict[str, Any]:
        return dict(retry_until_ready(lambda: evaluator.post("/v1/leagues/tictactoe/play", json=body)).json())

    body["actions"].append(move()["legal"][0])
    worker = only_process(served.storage, "evaluation.service.game_worker")
    os.kill(worker, signal.SIGKILL)
    until(lambda: worker not in processes(served.storage, "evaluation.service.game_worker"))
    body["actions"].append(move()["legal"][0])
    service = only_process(served.storage, ":EvaluationService")
    os.kill(service, signal.SIGKILL)
    document = move()
    assert [step["moves"][0]["action"] for step in document["steps"][1::2]] == body["actions"]
    until(lambda: service not in processes(served.storage, ":EvaluationService"))
    only_process(served.storage, "evaluation.service.game_worker")  # that of the killed service ends
    evaluate(tictactoe.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=served, blocks=1)
    video = f"/v1/leagues/tictactoe/matches/{Ledger(served).matches(league=tictactoe.LEAGUE)[-1].id}/games/1/video.gif"
    assert retry_until_ready(lambda: evaluator.get(video)).content[:6] == b"GIF89a"
    rejected = evaluator.post("/v1/leagues/tictactoe/play", json=body | {"actions": [9]})
    assert (rejected.status_code, rejected.json()["code"]) == (422, "illegal_action")
    assert "Traceback" not in rejected.text


def only_process(storage: Storage, name: str) -> int:
    """The only process of this name, once another one has ended."""
    until(lambda: len(processes(storage, name)) == 1)
    return processes(storage, name)[0]


def test_the_metrics_of_ray_contain_actions(storage: Storage) -> None:
    """The count of requests, and the gauges that Ray's dashboard shows of autoscaling."""
    with running(storage, replicas=1, dashboard=True) as url:
        (raylet,) = processes(storage, "raylet/raylet")
        session = re.search(r"/[^\0]*/session_[\d_-]+", Path(f"/proc/{raylet}/cmdline").read_text())
        assert session is not None
        (port,) = Path(session[0]).glob("metrics_export_port_*")

        def total(metric: str, label: str = 'deployment="PolicyServer"') -> float:
            """The sum of a metric's samples with a label, after one more action."""
            httpx.post(f"{url}{ACTION}", json={"observation": BOARD}).raise_for_status()
            text = httpx.get(f"http://127.0.0.1:{port.read_text()}/metrics").text
            samples = re.findall(rf"^ray_serve_{metric}\{{(.*)\}} (\S+)$", text, flags=re.M)
            return sum(float(value) for labels, value in samples if label in labels)

        until(lambda: total("deployment_request_counter_total", 'route="/v1/policies/{model}/action"') > 0)
        until(lambda: total("autoscaling_desired_replicas") == total("autoscaling_target_replicas") == 1)
        until(lambda: total("autoscaling_total_requests") > 0)


def test_a_killed_server_can_be_restarted(storage: Storage) -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    with running(storage, port=port, replicas=1) as url:
        os.kill(launcher(port), signal.SIGKILL)
        until(lambda: haproxy.is_free("127.0.0.1", port))  # not only when the next server starts
        with running(storage, port=port, replicas=1) as restarted:
            assert restarted == url
            reply = httpx.post(f"{url}{ACTION}", json={"observation": BOARD})
            assert reply.json()["version"] == 1
    assert haproxy.is_free("127.0.0.1", port)


@needs_ipv6
def test_a_server_on_ipv6_answers_until_its_terminal_closes(storage: Storage) -> None:
    port, grpc_port = haproxy.free_ports(2, "::1")
    command = [str(Path(sys.executable).with_name("league")), "serve", "--host", "::1"]
    command += ["--port", str(port), "--grpc-port", str(grpc_port), "--replicas", "1"]
    environment = os.environ | storage.environment
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            lines = iter(server.stdout.readline, "")
            assert f"on http://[::1]:{port}" in next(line for line in lines if line.startswith("Serving"))
            reply = httpx.post(f"http://[::1]:{port}{ACTION}", json={"observation": BOARD}, trust_env=False)
            assert reply.json()["version"] == 1
            assert tritonclient.grpc.InferenceServerClient(f"[::1]:{grpc_port}").is_server_ready()
            server.send_signal(signal.SIGHUP)
            assert server.wait(60) == 128 + signal.SIGHUP
        finally:
            server.kill()
    assert haproxy.is_free("::1", port)
    assert haproxy.is_free("::1", grpc_port)


def launcher(port: int) -> int:
    """The process that `running` started to serve on a port."""
    for child in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):
            if any(f'"port": {port}' in argument for argument in child.cmdline()):
                return child.pid
    raise AssertionError(f"no process serves on port {port}")


@pytest.fixture(scope="module")
def address(ray_server: RayServer) -> Address:
    promote(ray_server.registry, "board", 1)
    until(lambda: serving(ray_server.registry, 1) >= 2)
    return Address(ray_server.url.removeprefix("http://"), ray_server.grpc)


@pytest.mark.e2e
def test_each_form_of_the_client_is_answered(address: Address, served: Registry) -> None:
    for model in ("board", "pistons", "chess", "vector", "choice"):
        policy, ports = policy_of(served.storage, model)
        arrays = observations(ports, 4)
        for form in FORMS:
            with Triton(form, address) as triton:
                assert triton.call("is_server_live"), form
                assert triton.call("is_server_ready"), form
                assert triton.call("is_model_ready", model, "champion"), (model, form)
                assert_same(triton.infer(model, arrays).as_numpy("action"), policy.act(arrays).actions)


def wait_for_both_replicas(triton: Triton, served: Registry) -> None:
    """Both report to the registry that they have answered on one channel: HAProxy balances calls, not connections."""

    def have_answered() -> bool:
        for _ in range(4):
            triton.infer("vector", {"observation": np.zeros((1, 2), np.float32)})
        reports = served.replicas.reports().values()
        return sum(any(entry["name"] == "vector" for entry in report[REPORT]) for report in reports) == 2

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

    with load(caller, callers=4) as calls:
        until(lambda: calls.versions.total() > 200)
        os.kill(victim, signal.SIGKILL)
        after = calls.versions.total()
        until(lambda: calls.versions.total() > after + 1000)
    assert calls.failures == []
    until(lambda: len(set(processes(served.storage, "PolicyServer")) - {victim}) == 2)
