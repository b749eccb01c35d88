"""The real thing: Ray Serve, HAProxy and two replicas, under load, promotions and blows."""

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import httpx
import numpy as np
import pytest
from filelock import FileLock
from websockets.exceptions import ConnectionClosed

from evaluation.report import EvaluationReport
from evaluation.tournament import evaluate
from league.client import Client
from league.client.conversation import Conversation
from league.client.stream import Stream
from league.environments.building import interface
from league.errors import UnknownLeague
from league.policies.onnx import OnnxPolicy
from league.policies.remote import RemotePolicy
from league.registry.following import await_traffic
from league.registry.registry import Registry
from league.registry.rows import Portion
from league.results.ledger import Ledger
from league.results.records import Match
from league.settings import Storage
from serve_app import haproxy
from serve_app.launch import running
from tests.evaluation import examples
from tests.league.policies.graphs import masked_mlp
from tests.serve_app.leagues import everything, promote, publish
from tests.serve_app.scaling import scale
from tests.serve_app.test_action import BOARD
from tests.serve_app.test_events import listener

ACTION = "/v1/policies/board/action"
EVALUATIONS = "/v1/leagues/tictactoe/evaluations"
BATCH = {"observation": np.zeros((1, 6, 7, 2), np.int8), "action_mask": np.ones((1, 7), np.int8)}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Registry]:
    registry = everything(Storage.at(tmp_path_factory.mktemp("served")))
    tictactoe(registry)
    yield registry
    registry.close()


def tictactoe(registry: Registry) -> None:
    """A league that can be played, with two versions."""
    league = examples.config(play={"opening_plies": 2, "copies": 2})
    registry.register(league, interface(league))
    for graph in (examples.graph(), examples.graph(wins=True)):
        examples.publish(registry, graph)


@pytest.fixture(scope="module")
def url(served: Registry) -> Iterator[str]:
    with pytest.MonkeyPatch.context() as environment:
        # A replica that is to stop stays open for 30 s else.
        environment.setenv("RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S", "2")
        # There is a key, for evaluations. The others do without.
        with running(served.storage, replicas=2, insecure=True) as url:
            yield url
    until(lambda: not processes(served.storage, ""), seconds=10)  # a server that stopped leaves no process


def processes(storage: Storage, name: str) -> list[int]:
    """Processes of that name that serve `storage`, which they have in their environment."""
    home = f"LEAGUE_HOME={storage.home}\0".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            with suppress(OSError):
                if home in (entry / "environ").read_bytes() and name.encode() in (entry / "cmdline").read_bytes():
                    found.append(int(entry.name))
    return found


def until(condition: Callable[[], object], seconds: float = 60) -> None:
    deadline = monotonic() + seconds
    while not condition():
        assert monotonic() < deadline
        sleep(0.01)


def serving(registry: Registry, version: int) -> int:
    """How many replicas say that they serve a version of `board`."""
    return sum(said.version == version for said in registry.acknowledgements("board"))


@dataclass
class Load:
    """What callers saw."""

    versions: Counter[int] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)


@contextmanager
def load(caller: Callable[[], Callable[[], int]], callers: int) -> Iterator[Load]:
    """Call without pause from several threads while the context lasts.

    `caller` makes what one of them calls, which returns the version that answered.
    """
    seen, stop = Load(), threading.Event()

    def run() -> None:
        call = caller()
        while not stop.is_set():
            try:
                seen.versions[call()] += 1
            except Exception as error:
                seen.failures.append(repr(error))

    threads = [threading.Thread(target=run) for _ in range(callers)]
    for thread in threads:
        thread.start()
    try:
        yield seen
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def test_every_replica_answers_and_says_so(url: str, served: Registry) -> None:
    until(lambda: serving(served, 1) == 2)
    with httpx.Client(base_url=url) as client:
        found: set[str] = set()
        until(
            lambda: (
                found.add(client.post(ACTION, json={"observation": BOARD}).headers["x-league-replica"])
                or len(found) == 2
            )
        )
        assert found == {row["replica"] for row in client.get("/v1/leagues/board").json()["replicas"]}
        assert client.get("/v1/health/ready").status_code == 200


def test_one_scrape_tells_of_all_replicas(url: str, served: Registry) -> None:
    with httpx.Client(base_url=url) as client:
        for _ in range(50):
            client.post(ACTION, json={"observation": BOARD})

        def replicas() -> set[str]:
            lines = client.get("/metrics").text.splitlines()
            found = [line for line in lines if line.startswith("league_request_seconds_count{")]
            return {line.split('replica="')[1].split('"')[0] for line in found}

        until(lambda: len(replicas()) == 2)


def test_traffic_is_moved_while_requests_go_on(url: str, served: Registry) -> None:
    def caller() -> Callable[[], int]:
        client = httpx.Client(base_url=url, headers={"x-league-key": f"caller-{threading.get_ident()}"})

        def call() -> int:
            reply = client.post(ACTION, json={"observation": BOARD})
            assert reply.status_code == 200, reply.text
            return int(reply.json()["version"])

        return call

    promote(served, "board", 1)
    with load(caller, callers=4) as seen:
        for share in (1.0, 0.0, 1.0):
            canary, shadow = Portion(2, share), Portion(3, 1.0)
            setting = served.set_traffic("board", canary=canary, shadow=shadow, actor="test", reason="test")
            await_traffic(served, setting, 30)
            assert caller()() == (2 if share else 1)
        off = served.set_traffic("board", canary=None, shadow=None, actor="test", reason="test")
        await_traffic(served, off, 30)
    assert seen.failures == []
    assert seen.versions.keys() == {1, 2}
    until(lambda: [(one.candidate, one.failed) for one in served.shadowings("board")] == [(3, 0)])


def test_the_client_acts_as_the_graph_does(url: str) -> None:
    random = np.random.default_rng(0)
    mask = random.integers(0, 2, (50, 7), dtype=np.int8)
    mask[:, 0] = 1
    batch = {"observation": random.integers(0, 2, (50, 6, 7, 2), dtype=np.int8), "action_mask": mask}
    expected = OnnxPolicy(masked_mlp(seed=1)).act(batch).actions
    with RemotePolicy(url, "board", version=2) as policy:
        np.testing.assert_array_equal(policy.act(batch).actions, expected)
        explored = [
            policy.act(batch, explore=True, rng=[np.random.default_rng((7, row)) for row in range(50)]).actions
            for _ in range(2)
        ]
        np.testing.assert_array_equal(*explored)
        assert mask[np.arange(50), explored[0]].all()
    with RemotePolicy(url, "nobody") as policy, pytest.raises(UnknownLeague, match="known: board"):
        policy.act(BATCH)


def test_promotions_under_load_cost_no_request(url: str, served: Registry) -> None:
    def caller() -> Callable[[], int]:
        client = httpx.Client(base_url=url)

        def call() -> int:
            reply = client.post(ACTION, json={"observation": BOARD})
            assert reply.status_code == 200, reply.text
            return int(reply.json()["version"])

        return call

    ask = caller()
    with load(caller, callers=8) as seen:
        for version in (2, 3, 1) * 4:
            promote(served, "board", version)
            until(lambda version=version: serving(served, version) == 2)
            assert {ask() for _ in range(4)} == {version}, "nobody answers with the old one any more"
    assert seen.failures == []
    assert seen.versions.keys() == {1, 2, 3}


@pytest.mark.parametrize("has_length", [True, False], ids=["of a stated length", "in parts"])
def test_a_hundred_megabytes_are_refused(url: str, served: Registry, has_length: bool) -> None:
    size, part = 100 * 2**20, b" " * 2**16
    headers = {"content-type": "application/json"} | ({"content-length": str(size)} if has_length else {})
    before = memory(served.storage)
    with httpx.Client(base_url=url) as client:
        try:
            reply = client.post(ACTION, content=(part for _ in range(size // len(part))), headers=headers)
        except httpx.WriteError:
            pytest.fail("the connection was cut before the answer could be read")
        assert (reply.status_code, reply.json()["code"]) == (413, "body_too_large")
        assert client.post(ACTION, json={"observation": BOARD}).status_code == 200
    assert memory(served.storage) - before < 20 * 2**20


def memory(storage: Storage) -> int:
    """The largest resident size that a replica ever had, in bytes."""
    peaks = []
    for pid in processes(storage, "PolicyServer"):
        status = Path(f"/proc/{pid}/status").read_text()
        peaks += [int(line.split()[1]) * 1024 for line in status.splitlines() if line.startswith("VmHWM")]
    return max(peaks)


def test_the_death_of_a_replica_costs_our_client_no_request(url: str, served: Registry) -> None:
    victim = processes(served.storage, "PolicyServer")[0]

    def caller() -> Callable[[], int]:
        client = Client(url)
        return lambda: client.act("board", BOARD).version

    with load(caller, callers=8) as seen:
        until(lambda: seen.versions.total() > 200)
        os.kill(victim, signal.SIGKILL)
        after = seen.versions.total()
        until(lambda: seen.versions.total() > after + 2000)
    assert seen.failures == []
    until(lambda: len(set(processes(served.storage, "PolicyServer")) - {victim}) == 2)


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


def test_streams_of_events_come_through_and_outlast_every_limit(url: str, served: Registry) -> None:
    """HAProxy cuts a reply on which nothing comes for 5 s."""
    with listener(url) as heard:
        until(lambda: heard.lines.count(": nothing new") >= 4)
        promote(served, "board", 2)
        until(lambda: heard.last["aliases"] == {"champion": 2})
        until(lambda: heard.last["serving"] == {"2": 2})
        assert not heard.is_over
    promote(served, "board", 1)
    until(lambda: serving(served, 1) >= 2)


def test_episodes_outlive_a_replica_that_drains(url: str, served: Registry) -> None:
    """The observations are ones, and the third action is 1: whoever forgot what was before would answer 0.

    Streams of events at that replica end, the others go on.
    """
    with Client(url) as client, ExitStack() as until_done:
        listeners = [until_done.enter_context(listener(url)) for _ in range(6)]
        streams = [until_done.enter_context(client.stream("memory")) for _ in range(6)]
        for _ in range(2):
            assert [stream.act([1.0]) for stream in streams] == [0] * 6
        assert len(replicas(streams)) == 2
        with ended_streams() as codes:
            scale(processes(served.storage, "PolicyServer"), processes(served.storage, "raylet")[0], 1)
            until(lambda: [stream.act([0.0]) for stream in streams] and len(replicas(streams)) == 1)
        assert codes
        assert set(codes) == {1012}
        assert [stream.act([1.0]) for stream in streams] == [1] * 6
        until(lambda: any(each.is_over for each in listeners))
        assert not all(each.is_over for each in listeners)
        scale(processes(served.storage, "PolicyServer"), processes(served.storage, "raylet")[0], 2)
    until(lambda: serving(served, 1) >= 2)


def replicas(streams: list[Stream]) -> set[str]:
    return {stream.last.replica for stream in streams if stream.last is not None}


@contextmanager
def ended_streams() -> Iterator[list[int]]:
    """The codes by which servers close streams of our client while the context lasts."""
    codes: list[int] = []
    lost = Conversation.lost

    def noted(self: Conversation, error: Exception) -> Any:
        assert isinstance(error, ConnectionClosed), error
        codes.append(error.rcvd.code if error.rcvd is not None else 1006)
        return lost(self, error)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Conversation, "lost", noted)
        yield codes


def test_a_tampered_champion_never_answers(url: str, served: Registry) -> None:
    promote(served, "board", 1)
    until(lambda: serving(served, 1) >= 2)
    new = publish(served, "board", {"shared": masked_mlp(seed=8)}, "run/new").number
    graph = served.artifacts.path("board", new) / "shared.onnx"
    whole = graph.read_bytes()
    graph.write_bytes(masked_mlp(seed=9))
    promote(served, "board", new)
    with httpx.Client(base_url=url) as client:
        until(lambda: client.get("/v1/leagues/board").json()["faults"])
        for _ in range(20):
            assert client.post(ACTION, json={"observation": BOARD}).json()["version"] == 1
        graph.write_bytes(whole)
        until(lambda: serving(served, new) >= 2)


@pytest.fixture(scope="module")
def evaluator(url: str, served: Registry) -> Iterator[httpx.Client]:
    """Has a key that may start evaluations and nights, and play."""
    _, token = served.create_key("night-owl", ["act", "read", "evaluate", "promote"])
    with httpx.Client(base_url=url, headers={"x-api-key": token}, timeout=30) as client:
        until(lambda: client.delete(f"{EVALUATIONS}/99").status_code == 404)  # both replicas know it soon
        yield client


def start(client: httpx.Client, **body: Any) -> str:
    """Where the evaluation can be followed."""
    headers = {"idempotency-key": str(body)}
    until(lambda: client.post(EVALUATIONS, json=body, headers=headers).status_code == 202)
    return client.post(EVALUATIONS, json=body, headers=headers).headers["location"]


def ended(client: httpx.Client, place: str) -> dict[str, Any]:
    until(lambda: client.get(place).json()["state"] not in ("queued", "running"))
    return dict(client.get(place).json())


def at_home(directory: Path, blocks: int) -> tuple[EvaluationReport, list[Match]]:
    """What `league evaluate` plays of the same versions."""
    registry = Registry.open(Storage.at(directory))
    tictactoe(registry)
    report = evaluate(examples.LEAGUE, registry=registry, blocks=blocks)
    matches = Ledger(registry).matches(league=examples.LEAGUE)
    registry.close()
    return report, matches


def test_an_evaluation_that_is_killed_goes_on_and_is_what_league_evaluate_plays(
    evaluator: httpx.Client, served: Registry, tmp_path: Path
) -> None:
    report, matches = at_home(tmp_path, blocks=150)

    def played() -> list[Match]:
        return Ledger(served).matches(league=examples.LEAGUE, schedule=report.schedule)

    place = start(evaluator, blocks=150)
    until(lambda: Ledger(served).positions(report.schedule) if known(served, report.schedule) else False)
    (first,) = processes(served.storage, "evaluation.job")
    os.kill(first, signal.SIGKILL)
    left = played()
    assert 0 < len(left) < len(matches)
    assert left == matches[: len(left)]
    until(lambda: set(processes(served.storage, "evaluation.job")) - {first})
    document = ended(evaluator, place)
    assert (document["state"], document["error"]) == ("done", None)
    assert document["result"] == report.to_json()
    assert (document["progress"]["played"], document["progress"]["of"]) == (len(matches), len(matches))
    assert played() == matches


def known(registry: Registry, schedule: str) -> bool:
    return schedule in [each.id for each in Ledger(registry).schedules(examples.LEAGUE)]


def test_an_evaluation_is_stopped_between_chunks(evaluator: httpx.Client, served: Registry) -> None:
    place = start(evaluator, blocks=20_000)
    until(lambda: evaluator.get(place).json()["progress"])
    assert evaluator.delete(place).json()["stopped_by"] == "night-owl"
    document = ended(evaluator, place)
    assert (document["state"], document["result"]) == ("stopped", None)
    assert 0 < document["progress"]["played"] < document["progress"]["of"]
    until(lambda: not processes(served.storage, "evaluation.job"))


def test_a_night_that_finds_another_at_work_says_so_and_the_next_one_promotes(
    evaluator: httpx.Client, served: Registry
) -> None:
    locks = served.storage.home / "locks"
    locks.mkdir(exist_ok=True)
    with FileLock(locks / "nightly-tictactoe.lock"):
        refused = ended(evaluator, start(evaluator, kind="nightly", reason="first"))
    assert (refused["state"], refused["error"]["code"]) == ("failed", "already_running")
    assert "nightly-tictactoe.lock" in refused["error"]["message"]
    night = ended(evaluator, start(evaluator, kind="nightly", reason="second"))
    assert (night["state"], night["result"]["champion"]) == ("done", "tictactoe@2")
    assert served.aliases("tictactoe")["champion"] == 2


def patiently(ask: Callable[[], httpx.Response]) -> httpx.Response:
    """What is answered in the end to a request that may take longer than one waits."""
    replies: list[httpx.Response] = []
    until(lambda: replies.append(ask()) or replies[-1].status_code != 503)
    assert all(reply.json()["code"] in ("not_ready", "no_studio") for reply in replies[:-1])
    assert all("retry-after" in reply.headers for reply in replies[:-1])
    assert replies[-1].status_code == 200, replies[-1].text
    return replies[-1]


def test_a_recorded_game_is_shown_and_filmed_by_the_studio(evaluator: httpx.Client, served: Registry) -> None:
    evaluate(examples.LEAGUE, ["tictactoe@1", "tictactoe@2"], registry=served, blocks=1)
    match = Ledger(served).matches(league=examples.LEAGUE)[-1]
    game = f"/v1/leagues/tictactoe/matches/{match.id}/games/1"
    document = patiently(lambda: evaluator.get(game)).json()
    actions = [move["action"] for step in document["steps"] for move in step["moves"]]
    assert actions == [*match.games[1].opening, *match.games[1].actions]
    assert patiently(lambda: evaluator.get(f"{game}/film.gif")).content[:6] == b"GIF89a"


def test_a_game_goes_on_whatever_dies_in_its_midst(evaluator: httpx.Client, served: Registry) -> None:
    body: dict[str, Any] = {"opponent": "tictactoe@2", "agent": "player_1", "chances": True, "actions": []}

    def move() -> dict[str, Any]:
        return dict(patiently(lambda: evaluator.post("/v1/leagues/tictactoe/play", json=body)).json())

    body["actions"].append(move()["legal"][0])
    (stage,) = processes(served.storage, "evaluation.stage")
    os.kill(stage, signal.SIGKILL)
    until(lambda: stage not in processes(served.storage, "evaluation.stage"))
    body["actions"].append(move()["legal"][0])
    (studio,) = processes(served.storage, ":Studio")
    os.kill(studio, signal.SIGKILL)
    document = move()
    assert [each["moves"][0]["action"] for each in document["steps"][1::2]] == body["actions"]
    until(lambda: studio not in processes(served.storage, ":Studio"))
    assert len(processes(served.storage, "evaluation.stage")) == 1, "the one of the studio that died is gone"
    refused = evaluator.post("/v1/leagues/tictactoe/play", json=body | {"actions": [9]})
    assert (refused.status_code, refused.json()["code"]) == (422, "illegal_action")
    assert "Traceback" not in refused.text


def test_a_server_that_was_killed_can_be_started_again(storage: Storage) -> None:
    (port,) = haproxy.free_ports(1, "127.0.0.1")
    with running(storage, port=port, replicas=1) as url:
        os.kill(launcher(port), signal.SIGKILL)
        with running(storage, port=port, replicas=1) as again:
            assert again == url
            reply = httpx.post(f"{url}{ACTION}", json={"observation": BOARD})
            assert reply.json()["version"] == 1
    assert haproxy.is_free("127.0.0.1", port)


def launcher(port: int) -> int:
    """The process that `running` started to serve on a port."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    return next(int(pid) for pid in children if f'"port": {port}' in Path(f"/proc/{pid}/cmdline").read_text())
