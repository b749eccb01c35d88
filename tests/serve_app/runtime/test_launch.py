"""Faults are reported in one sentence before Ray starts; what bypasses Ray, and the number of replicas."""

import asyncio
import pickle
import socket
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from ray.serve._private.common import DeploymentID, ReplicaID, TimeStampedValue
from ray.serve.config import AutoscalingConfig, AutoscalingPolicy
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient
from starlette.types import Receive, Scope, Send

from league.errors import AlreadyRunning, ConfigError, NotReady, StorageError
from league.registry.replicas import LIVENESS_TIMEOUT
from league.settings import Storage
from serve_app.runtime import haproxy, launch, ray_serve, serve_bypass
from serve_app.runtime.autoscaling import LOAD, MARGIN, STALE, LoadPolicy, required_replicas
from serve_app.runtime.launch import DEPLOY_YAML, load_document, running
from serve_app.runtime.replica_process import has_ended, this_process
from serve_app.runtime.timeouts import TimeLimitExceeded, run_within
from serve_app.settings import ServeSettings, is_exposed
from tests.support.waiting import until


def load(deploy: Path = DEPLOY_YAML, replicas: int | None = None, max_replicas: int | None = None) -> dict[str, Any]:
    return load_document(deploy, None, None, None, replicas, max_replicas, insecure=False)


def test_a_port_in_use_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        (free,) = haproxy.free_ports(1, "127.0.0.1")
        for http, grpc in ((port, free), (free, port)):
            document = load_document(DEPLOY_YAML, None, http, grpc, None, None, insecure=False)
            with pytest.raises(AlreadyRunning, match=f"port {port} of 127.0.0.1 is in use"):
                launch._serve_locally(document, dashboard=False, on_ready=None)


def test_a_host_that_is_not_of_this_machine_is_reported() -> None:
    document = load_document(DEPLOY_YAML, "203.0.113.1", None, None, None, None, insecure=True)
    with pytest.raises(ConfigError, match=r"203\.0\.113\.1: Cannot assign requested address"):
        launch._serve_locally(document, dashboard=False, on_ready=None)


def test_the_urls_of_a_server() -> None:
    for host, url, url_here in (
        ("127.0.0.1", "http://127.0.0.1:80", "http://127.0.0.1:80"),
        ("0.0.0.0", "http://0.0.0.0:80", "http://127.0.0.1:80"),
        ("::1", "http://[::1]:80", "http://[::1]:80"),
        ("::", "http://[::]:80", "http://[::1]:80"),
    ):
        assert (ray_serve.url_of(host, 80), ray_serve.url_here(host, 80)) == (url, url_here)


def test_invalid_settings_are_reported(tmp_path: Path) -> None:
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(DEPLOY_YAML.read_text().replace("    args:\n", "    args:\n      max_body: 1\n"))
    with pytest.raises(ConfigError, match="max_body"):
        launch._settings(load(deploy))


def test_an_invalid_deploy_yaml_is_reported(tmp_path: Path) -> None:
    deploy = tmp_path / "deploy.yaml"
    impossible = DEPLOY_YAML.read_text().replace("target: 0.6", "target: 60")
    unreadable = ("", "applications: []", "http_options: {}", "a: [", "- 1")
    for text, message in (
        *((text, r"deploy\.yaml") for text in unreadable),
        (impossible, "target must be greater than 0 and less than 1, got 60"),
    ):
        deploy.write_text(text)
        with pytest.raises(ConfigError, match=message):
            load(deploy)
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load(tmp_path / "nowhere.yaml")


def test_an_unusable_home_and_a_missing_haproxy_are_reported(
    storage: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(StorageError, match="file"):
        launch._check_exposure(load(), Storage.at(tmp_path / "file" / "home"))
    monkeypatch.setenv("RAY_SERVE_HAPROXY_BINARY_PATH", "/nowhere/haproxy")
    with pytest.raises(NotReady, match="HAProxy is missing"), running(storage):
        pass


def test_the_options_set_the_bounds_of_the_number_of_replicas() -> None:
    for options, expected in (((None, None), (2, 2)), ((3, None), (3, 3)), ((1, 4), (1, 4)), ((None, 5), (2, 5))):
        bounds = load(DEPLOY_YAML, *options)["applications"][0]["deployments"][0]["autoscaling_config"]
        assert (bounds["min_replicas"], bounds["max_replicas"]) == expected
    for options, message in (
        ((3, 2), "--max-replicas must be at least 3, as --replicas or min_replicas, got 2"),
        ((None, 1), "--max-replicas must be at least 2, as --replicas or min_replicas, got 1"),
        ((0, 2), "min_replicas must be at least 1, got 0"),
    ):
        with pytest.raises(ConfigError, match=message):
            load(DEPLOY_YAML, *options)


def test_a_deploy_yaml_may_have_a_fixed_number_of_replicas(tmp_path: Path) -> None:
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    deployment = document["applications"][0]["deployments"][0]
    del deployment["autoscaling_config"]
    deployment["num_replicas"] = 2
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(yaml.safe_dump(document))
    loaded = load(deploy, 3)
    assert loaded["applications"][0]["deployments"][0]["num_replicas"] == 3
    with pytest.raises(ConfigError, match=r"--max-replicas: deploy\.yaml has num_replicas"):
        load(deploy, max_replicas=3)


def test_passwords_reach_neither_command_lines_nor_clusters(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = Storage(tmp_path, "postgresql://league:secret@192.0.2.1/league", tmp_path / "artifacts")
    commands = []

    class Recorded(launch.Subprocess):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            # The command line is set shortly after the constructor returns.
            until(Path(f"/proc/{self.pid}/cmdline").read_text)
            commands.append(Path(f"/proc/{self.pid}/cmdline").read_text())

    monkeypatch.setattr(launch, "Subprocess", Recorded)
    with pytest.raises(ConfigError, match="none"), running(storage, deploy=tmp_path / "none.yaml"):
        pass
    assert ["serve_app.runtime.launch" in command for command in commands] == [True]
    assert "secret" not in commands[0]
    with pytest.raises(ConfigError, match="LEAGUE_DATABASE_URL contains a password"):
        launch._serve_on_cluster("127.0.0.1:9", storage, {}, None)


INCONSISTENT: tuple[tuple[dict[str, Any], str], ...] = (
    ({"heartbeat": 6}, "heartbeat must be at most 5"),
    ({"poll": 10}, "poll_slowest must be at least poll"),
    ({"max_body": 1}, "max_body"),
    ({"max_bodies": 1}, "max_bodies"),
    ({"root_path": "ai"}, "expected a path like /ai"),
    ({"root_path": "/ai/"}, "expected a path like /ai"),
    ({"root_path": "/ai?x"}, "expected a path like /ai"),
    ({"root_path": "/leagues"}, "begins like a path of this server"),
    ({"root_path": "/v1/ai"}, "begins like a path of this server"),
    ({"cors_origins": ["*"]}, "expected an origin like"),
    ({"cors_origins": ["https://game.example/"]}, "expected an origin like"),
    ({"cors_origins": ["https://game.example"], "require_keys": "never"}, "cors_origins needs API keys"),
)


def test_inconsistent_settings_are_rejected() -> None:
    for setting, message in INCONSISTENT:
        with pytest.raises(ValidationError, match=message):
            ServeSettings.model_validate(setting)
    assert 3 * ServeSettings().heartbeat <= LIVENESS_TIMEOUT.total_seconds(), "two heartbeats may be lost"


def test_deploy_yaml_updates_without_lost_requests() -> None:
    from ray.serve.config import AutoscalingConfig
    from ray.serve.schema import ServeDeploySchema

    schema = ServeDeploySchema.model_validate(yaml.safe_load(DEPLOY_YAML.read_text()))
    (application,) = schema.applications
    (deployment,) = application.deployments
    assert application.import_path == "serve_app.app:build_app"
    ServeSettings.model_validate(application.args)
    assert schema.http_options.host == "127.0.0.1"
    replicas = AutoscalingConfig.model_validate(deployment.autoscaling_config)
    assert replicas.min_replicas >= 2, "one replica may fail"
    assert replicas.min_replicas == replicas.max_replicas, "evaluations share the cores"
    assert deployment.max_surge_percent == 100, "new replicas start before old ones stop"
    assert deployment.graceful_shutdown_timeout_s >= 40, "draining takes 30 s"
    assert deployment.backpressure_config.status_code == 429
    both = 2 * replicas.max_replicas * deployment.ray_actor_options.num_cpus
    assert both <= 2, "old and new replicas must fit on two cores"


def test_all_but_loopback_addresses_are_exposed() -> None:
    for host in ("127.0.0.1", "127.9.9.9", "localhost", "::1", "[::1]"):
        assert not is_exposed(host)
    for host in ("0.0.0.0", "::", "10.0.0.1", "192.168.1.2", "example.org", "", "localhost.evil"):
        assert is_exposed(host)


REPLICA = """
import sys
from serve_app.runtime.worker_start import import_serve

import_serve()
print({"pandas", "pyarrow", "sqlalchemy"} & sys.modules.keys())
import serve_app.app, serve_app.runtime.serve_bypass
heavy = {"torch", "pettingzoo", "supersuit", "mpe2", "tensorflow"} & {name.partition(".")[0] for name in sys.modules}
print(heavy | {name for name in sys.modules if name.startswith(("ray.rllib", "league.environments"))})
print(serve_app.runtime.replica_process.this_process().description["process"])
import pandas
from ray.serve._private import utils
print(utils.pd)
"""


@pytest.fixture(scope="module")
def printed() -> list[str]:
    """What a process prints that imports the modules of a replica."""
    process = subprocess.run([sys.executable, "-c", REPLICA], capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr
    return process.stdout.splitlines()


def test_which_processes_have_ended(printed: list[str]) -> None:
    """Nothing is known of a replica that does not describe its process: another release may use other keys."""
    assert has_ended({"process": printed[2]})
    for description in (this_process().description, {"machine": "another/1", "pid": "1", "start": "1"}, {}):
        assert not has_ended(description)


def test_ray_serve_is_imported_without_pandas_which_others_can_import(printed: list[str]) -> None:
    assert (printed[0], printed[3]) == ("set()", "None")


def test_a_replica_imports_neither_torch_nor_environments(printed: list[str]) -> None:
    assert printed[1] == "set()"


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> TestClient:
    monkeypatch.setattr(serve_bypass, "_application", None)
    monkeypatch.setattr(serve_bypass, "_root_path", "")
    (outer,) = serve_bypass.middlewares()
    return TestClient(outer.cls(PlainTextResponse("serve"), *outer.args, **outer.kwargs))


def test_which_requests_bypass_ray_serve(client: TestClient) -> None:
    assert client.post("/v1/policies/board/action").text == "serve", "this process has no application"
    serve_bypass.install(PlainTextResponse("bypass"))
    for path in ("/v1/policies/board/action", "/v2/models/board/infer", "/v1/leagues", "/", "/-/other"):
        assert client.post(path).text == "bypass", path
    for path in ("/-/healthz", "/-/routes"):
        assert client.post(path).text == "serve", path


async def echo(scope: Scope, receive: Receive, send: Send) -> None:
    await PlainTextResponse(f"{scope['path']} {scope['raw_path'].decode()}")(scope, receive, send)


def test_the_root_path_is_removed(client: TestClient) -> None:
    serve_bypass.install(echo, "/ai")
    for path, text in (
        ("/ai/v1/policies/board/action", "/v1/policies/board/action /v1/policies/board/action"),
        ("/v1/policies/board/action", "/v1/policies/board/action /v1/policies/board/action"),
        ("/ai/v2/models/a%2Fb/infer", "/v2/models/a/b/infer /v2/models/a%2Fb/infer"),
        ("/ai/leagues/a%2Fb", "/leagues/a/b /leagues/a%2Fb"),
        ("/ai/", "/ /"),
        ("/ai", "/ /"),
        ("/ai/-/healthz", "serve"),
        ("/aims/v1/policies/board/action", "/aims/v1/policies/board/action /aims/v1/policies/board/action"),
        ("/v1/policies/ai/ai", "/v1/policies/ai/ai /v1/policies/ai/ai"),
    ):
        assert client.post(path).text == text, path


def test_the_rest_of_the_server_sees_paths_without_the_root_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serve_bypass, "_application", None)
    monkeypatch.setattr(serve_bypass, "_root_path", "/ai")
    client = TestClient(serve_bypass.ServeBypass(echo))
    paths = [client.get(path).text for path in ("/ai", "/ai/", "/ai/leagues/a%2Fb", "/aims")]
    assert paths == ["/ /", "/ /", "/leagues/a/b /leagues/a%2Fb", "/aims /aims"]


LONG = 60.0


@pytest.mark.anyio
async def test_work_that_does_not_wait_completes_without_time() -> None:
    async def work() -> int:
        return 5

    assert await run_within(0, work()) == 5


@pytest.mark.anyio
async def test_waiting_work_gets_results_and_errors() -> None:
    async def work(future: asyncio.Future[int]) -> int:
        await asyncio.sleep(0)
        try:
            number = await future
        except ZeroDivisionError:
            number = -1
        return number + await asyncio.to_thread(lambda: 1)

    loop = asyncio.get_running_loop()
    good, bad = loop.create_future(), loop.create_future()
    loop.call_later(0.01, good.set_result, 41)
    loop.call_later(0.01, bad.set_exception, ZeroDivisionError())
    assert await run_within(LONG, work(good)) == 42
    assert await run_within(LONG, work(bad)) == 0


@pytest.mark.anyio
async def test_errors_are_passed_on() -> None:
    async def work(waits: bool) -> None:
        if waits:
            await asyncio.sleep(0)
        raise TimeoutError("its own")

    for waits in (False, True):
        with pytest.raises(TimeoutError, match="its own"):
            await run_within(LONG, work(waits))


@pytest.mark.anyio
async def test_work_that_waits_too_long_is_cancelled_and_can_clean_up() -> None:
    cleaned_up = []

    async def work() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            await asyncio.sleep(0)
            cleaned_up.append(True)

    with pytest.raises(TimeLimitExceeded):
        await run_within(0.01, work())
    assert cleaned_up


@pytest.mark.anyio
async def test_a_cancelled_caller_cancels_the_work() -> None:
    is_cancelled = False

    async def work() -> None:
        nonlocal is_cancelled
        try:
            await asyncio.Event().wait()
        except asyncio.CancelledError:
            is_cancelled = True
            raise

    task = asyncio.create_task(run_within(LONG, work()))
    for _ in range(2):
        await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert is_cancelled


TARGET = 0.6
targets = st.floats(0.2, 0.9)
loads = st.lists(st.none() | st.floats(0, 4), max_size=20)
bounds = st.tuples(st.integers(1, 10), st.integers(0, 10)).map(lambda pair: (pair[0], sum(pair)))


@given(loads, targets, st.integers(0, 30), bounds)
def test_the_bounds_are_respected(
    loads: list[float | None], target: float, current: int, bounds: tuple[int, int]
) -> None:
    assert bounds[0] <= required_replicas(loads, target, current, *bounds) <= bounds[1]


@given(st.floats(0, 3), loads, targets, st.integers(1, 30), st.floats(0, 3))
def test_more_load_needs_no_fewer_replicas(
    load: float, others: list[float | None], target: float, current: int, more: float
) -> None:
    light, heavy = ([first, *others] for first in (load, load + more))
    assert required_replicas(heavy, target, current, 1, 99) >= required_replicas(light, target, current, 1, 99)


@given(loads.filter(lambda numbers: None in numbers), targets, st.integers(1, 30))
def test_no_replica_is_removed_while_a_load_is_unknown(loads: list[float | None], target: float, current: int) -> None:
    assert required_replicas(loads, target, current, 1, 99) >= current


@given(
    st.floats(0, 8),
    st.floats(0.3, 0.9),
    st.floats(0, 0.05),
    st.integers(1, 20),
    st.integers(0, 2**32 - 1),
)
def test_a_constant_load_gets_a_constant_number(
    demand: float, target: float, overhead: float, current: int, seed: int
) -> None:
    """Replicas share the demand, in cores; each has an overhead, cannot use more than a core, and measures up to a
    tenth wrongly. The number may grow and then shrink, but never grows again.
    """
    numbers = [current]
    for row in np.random.default_rng(seed).uniform(0.9, 1.1, size=(30, 20)).tolist():
        share = min(1.0, demand / numbers[-1] + overhead)
        numbers.append(required_replicas([share * noise for noise in row[: numbers[-1]]], target, numbers[-1], 1, 20))
    grows = [after > before for before, after in pairwise(numbers) if after != before]
    assert grows == sorted(grows, reverse=True)
    assert numbers[-1] == numbers[-2]


def test_examples() -> None:
    for loads, current, expected in (
        ([0.5], 1, 1),
        ([0.7], 1, 2),
        ([1.0], 1, 2),
        ([1.0, 1.0], 2, 4),
        ([1.0, 0.0], 2, 2),
        ([0.27, 0.27], 2, 2),
        ([0.2, 0.2], 2, 1),
        ([0.2], 2, 1),
        ([], 2, 1),
        ([None, 1.9], 2, 4),
        ([0.0, None], 2, 2),
    ):
        assert required_replicas(loads, TARGET, current, 1, 10) == expected, loads
    assert MARGIN == 0.2
    for target in (0, 1, -0.1, 1.5):
        with pytest.raises(ValueError, match="target must be greater than 0 and less than 1"):
            LoadPolicy(target)


class Controller:
    """Calls a policy as Ray's controller does, with a clock of its own."""

    def __init__(self, replicas: int) -> None:
        application = DeploymentID("PolicyServer", "policy-league")
        self.replicas = [ReplicaID(f"replica-{i}", application) for i in range(replicas)]
        self.reports: dict[ReplicaID, list[TimeStampedValue]] = {}
        self.now = 1000.0
        self.state: dict[str, Any] = {}

    def decide(self, policy: LoadPolicy) -> int:
        context: Any = SimpleNamespace(
            running_replicas=self.replicas,
            raw_metrics={LOAD: self.reports},
            target_num_replicas=len(self.replicas),
            capacity_adjusted_min_replicas=1,
            capacity_adjusted_max_replicas=4,
            policy_state=dict(self.state),
            current_time=self.now,
        )
        number, self.state = policy(context)
        return number


def test_the_load_is_the_mean_of_the_samples() -> None:
    controller = Controller(1)
    controller.reports = {controller.replicas[0]: [TimeStampedValue(at, load) for at, load in ((1, 0.2), (2, 0.9))]}
    assert controller.decide(LoadPolicy(TARGET)) == 1
    controller.reports[controller.replicas[0]] += [TimeStampedValue(3, 0.9)]
    assert controller.decide(LoadPolicy(TARGET)) == 2


def test_statistics_that_no_longer_change_are_unknown() -> None:
    """Clocks of nodes differ: the age of a report is the time since it arrived."""
    controller, policy = Controller(2), LoadPolicy(TARGET)
    alive, stuck = controller.replicas
    controller.reports = {replica: [TimeStampedValue(5e9, 0.01)] for replica in controller.replicas}
    assert controller.decide(policy) == 1
    controller.now += STALE + 1
    controller.reports[alive] = [TimeStampedValue(5e9 + 1, 0.01)]
    assert controller.decide(policy) == 2
    controller.reports[stuck] = [TimeStampedValue(5e9 + 1, 0.01)]
    assert controller.decide(policy) == 1


def test_ray_accepts_the_policy_of_deploy_yaml() -> None:
    """Ray sends it to its controller by value."""
    (deployment,) = yaml.safe_load(DEPLOY_YAML.read_text())["applications"][0]["deployments"]
    config = AutoscalingConfig.model_validate(deployment["autoscaling_config"])
    assert config.look_back_period_s > config.metrics_interval_s
    assert isinstance(config.policy, AutoscalingPolicy)
    serialized = config.policy.get_serialized_policy_def()
    assert serialized is not None
    policy = pickle.loads(serialized)(**config.policy.policy_kwargs)
    assert Controller(3).decide(policy) == 3
    assert b"serve_app.observability" not in serialized
