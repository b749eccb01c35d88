"""LitServe, MLServer and BentoML, each in a virtual environment of its own, which is created in a cache folder.

All of them run our graph with ONNX Runtime, so that only the servers differ.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import venv
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version as installed
from pathlib import Path

from benchmarks.leagues.served_league import BODY, PLANES
from serve_app.runtime import haproxy

HERE = Path(__file__).parent
STOP_TIMEOUT = 10.0
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "policy-league" / "peers"
MLSERVER_BODY = json.dumps(
    {
        "inputs": [
            {"name": "observation", "datatype": "INT8", "shape": [1, *PLANES.shape], "data": PLANES.ravel().tolist()},
            {"name": "action_mask", "datatype": "INT8", "shape": [1, 7], "data": [1] * 7},
        ]
    }
).encode()


@dataclass(frozen=True, slots=True)
class Launch:
    """A command that serves until it receives SIGTERM."""

    command: list[str]
    environment: dict[str, str]
    directory: Path
    path: str
    """Of the URL that answers."""


@dataclass(frozen=True, slots=True)
class Framework:
    """A server to compare with.

    Attributes:
        requirements: For pip; the first one names the version.
        body: A request for one action.
        launch: Python of its environment, graph, three free ports and a scratch directory → its command.
    """

    name: str
    requirements: tuple[str, ...]
    body: bytes
    launch: Callable[[Path, Path, list[int], Path], Launch]

    def python(self, cache: Path) -> Path:
        """The Python of the framework's environment, which is created if necessary."""
        requirements = [*self.requirements, f"onnxruntime=={installed('onnxruntime')}"]
        key = hashlib.sha256(repr((requirements, sys.version_info[:2])).encode()).hexdigest()[:8]
        home = cache / f"{self.name}-{key}"
        python, complete = home / "bin" / "python", home / "complete"
        if not complete.exists():
            print(f"installing {', '.join(requirements)} into {home}", flush=True)
            shutil.rmtree(home, ignore_errors=True)
            venv.create(home, with_pip=True)
            subprocess.run([python, "-m", "pip", "install", "-q", *requirements], check=True)
            complete.touch()
        return python

    @contextmanager
    def serving(self, graph: Path, cache: Path, scratch: Path) -> Iterator[tuple[str, "subprocess.Popen[bytes]"]]:
        """Start the server; yield its URL, which may not answer yet, and its process."""
        ports = haproxy.free_ports(3, "127.0.0.1")
        launch = self.launch(self.python(cache), graph, ports, scratch)
        environment = os.environ | {"OMP_NUM_THREADS": "1"} | launch.environment
        output = scratch / f"{self.name}.log"
        with output.open("wb") as log:
            server = subprocess.Popen(
                launch.command, cwd=launch.directory, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        try:
            yield f"http://127.0.0.1:{ports[0]}{launch.path}", server
        except RuntimeError as error:
            raise RuntimeError(f"{error}:\n{output.read_text(errors='replace')[-2000:]}") from error
        finally:
            _stop(server)


def _stop(server: "subprocess.Popen[bytes]") -> None:
    """End a server and the processes that it started."""
    with suppress(ProcessLookupError):
        os.killpg(server.pid, signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            server.wait(STOP_TIMEOUT)
        os.killpg(server.pid, signal.SIGKILL)
    server.wait()


def _litserve(python: Path, graph: Path, ports: list[int], scratch: Path) -> Launch:
    command = [str(python), str(HERE / "litserve_server.py"), str(graph), str(ports[0])]
    return Launch(command, {}, scratch, "/predict")


def _mlserver(python: Path, graph: Path, ports: list[int], scratch: Path) -> Launch:
    folder = scratch / "mlserver"
    folder.mkdir(exist_ok=True)
    names = ("http_port", "grpc_port", "metrics_port")
    settings = {"host": "127.0.0.1", "parallel_workers": 1, "debug": False} | dict(zip(names, ports, strict=True))
    model = {"name": "four", "implementation": "mlserver_server.Policy", "parameters": {"uri": str(graph)}}
    (folder / "settings.json").write_text(json.dumps(settings))
    (folder / "model-settings.json").write_text(json.dumps(model))
    command = [str(python.with_name("mlserver")), "start", str(folder)]
    return Launch(command, {"PYTHONPATH": str(HERE)}, folder, "/v2/models/four/infer")


def _bentoml(python: Path, graph: Path, ports: list[int], scratch: Path) -> Launch:
    serve = [str(python.with_name("bentoml")), "serve", "bentoml_server:Policy"]
    command = [*serve, "--host", "127.0.0.1", "--port", str(ports[0])]
    environment = {"PEER_GRAPH": str(graph), "BENTOML_DO_NOT_TRACK": "True", "BENTOML_HOME": str(scratch / "bentoml")}
    return Launch(command, environment, HERE, "/act")


FRAMEWORKS = (
    Framework("litserve", ("litserve==0.2.19",), BODY, _litserve),
    # Its workers do not start with uvloop 0.22.
    Framework("mlserver", ("mlserver==1.7.1", "uvloop==0.21.0"), MLSERVER_BODY, _mlserver),
    Framework("bentoml", ("bentoml==1.4.39",), BODY, _bentoml),
)
