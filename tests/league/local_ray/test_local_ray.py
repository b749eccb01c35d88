"""A local Ray in a process of its own: where it listens, its token, and a start that takes long."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from league.local_ray import token

DEADLINE = 240
TOKENS = (token.MODE, token.TOKEN, token.TOKEN_FILE)
START = """
import os, signal, sys, threading
from contextlib import suppress
import psutil, ray
from ray._private import services
from league.local_ray import loopback_node, token
from ray._private.authentication.http_token_authentication import get_auth_headers_if_auth_enabled
from league.ray_cluster import PRELOAD, LocalRay, join, ray_session, start_local
from tests.support.waiting import until

loopback_node.NOTICE = 0.2
this = psutil.Process()

def below(name):
    found = []
    for process in this.children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if process.name() == name or any(part.endswith(name) for part in process.cmdline()):
                found.append(process)
    return found

def when_a_raylet_starts(act):
    start = services.start_ray_process

    def start_and_act(command, process_type, *arguments, **options):
        started = start(command, process_type, *arguments, **options)
        if process_type == "raylet":
            act(started.process)  # before it can register
        return started

    services.start_ray_process = start_and_act

def run_a_task():
    return ray.get(ray.remote(lambda: "a task ran").remote())
"""
LISTENERS = """
start_local(LocalRay(cpus=1))
print(run_a_task())
listeners = set()
for process in [this, *this.children(recursive=True)]:
    with suppress(psutil.NoSuchProcess):
        connections = process.net_connections("tcp")
        listeners |= {one.laddr.ip.removeprefix("::ffff:") for one in connections if one.status == "LISTEN"}
assert listeners == {"127.0.0.1"}, listeners
assert ray.util.get_node_ip_address() == "127.0.0.1"
address = ray.get_runtime_context().gcs_address
import subprocess
script = "import ray; from league.ray_cluster import join; join(sys.argv[1]); print(*ray.cluster_resources())"
command = [sys.executable, "-c", "import sys; " + script, address]
strangers = {name: value for name, value in os.environ.items() if name != token.TOKEN}
pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
joining, refused = (subprocess.Popen(command, env=env, **pipes) for env in (os.environ, strangers))
output, errors = joining.communicate()
assert "CPU" in output, errors
output, errors = refused.communicate()
assert "ConfigError: no Ray cluster" in errors and "CPU" not in output, (output, errors)
"""
PROCESSES = """
start_local(LocalRay(cpus=1))
print(run_a_task())

def names():
    found = []
    for process in this.children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if not process.name().startswith("ray::"):
                found.append(process.name())
    return sorted(found)

try:  # a worker that starts has another name first
    until(lambda: names() == ["cat", "cat", "gcs_server", "raylet"], 60)
except TimeoutError:
    sys.exit(f"unexpected processes: {names()}")
agents, (raylet,) = below("cat"), below("raylet")
raylet.kill()
_, alive = psutil.wait_procs(agents, timeout=60)
print("agents that survive the raylet:", len(alive))
"""
WAITING_WORKERS = """
start_local(LocalRay(cpus=1, preload="wave"))
until(lambda: below("ray::IDLE"))
waiting = below("ray::IDLE")

@ray.remote(num_cpus=1)
class Actor:
    def state(self):
        return os.getpid(), "wave" in sys.modules

pid, has_module = ray.get(Actor.remote().state.remote())
assert pid in [worker.pid for worker in waiting]
variables = [PRELOAD, *loopback_node.LIMITS, *loopback_node.WITHOUT_AGENTS, *loopback_node.WAITING_WORKERS]
assert not [name for name in variables if name in os.environ], "another node would inherit them"
print("imported before:", has_module)
"""
SLOW_AGENTS = """
stopped = {}
is_over = threading.Event()

def stop_agents():
    while not is_over.wait(0.01):
        for process in below("dashboard/agent.py"):
            if process.ppid() != this.pid and process.pid not in stopped:
                process.suspend()
                stopped[process.pid] = process

thread = threading.Thread(target=stop_agents)
thread.start()
start_local(LocalRay(cpus=1, dashboard=True))
is_over.set()
thread.join()
print(run_a_task(), "while", len(stopped), "agent is stopped")
for process in stopped.values():
    process.resume()
"""
SLOW_RAYLET = """
stopped = []
print_line = loopback_node.say

def stop(raylet):
    raylet.send_signal(signal.SIGSTOP)
    stopped.append(raylet)

def say(line):
    print_line(line)
    stopped[0].send_signal(signal.SIGCONT)

loopback_node.say = say
when_a_raylet_starts(stop)
start_local(LocalRay(cpus=1))
print(run_a_task())
"""
DEAD_RAYLETS = """
from league.errors import NotReady

most = int(sys.argv[1])
killed = []

def kill(raylet):
    if len(killed) < most:
        raylet.kill()
        killed.append(raylet)

when_a_raylet_starts(kill)
try:
    start_local(LocalRay(cpus=1))
    print(run_a_task(), "after", len(killed), "was killed")
except NotReady as error:
    print(error)
    assert below("gcs_server") == [], "processes are left behind"
"""
TWICE = """
tokens = []
for _ in range(2):
    with ray_session():
        start_local(LocalRay(cpus=1))
        print(run_a_task())
        tokens.append(os.environ[token.TOKEN])
assert not os.environ.keys() & {token.TOKEN, token.MODE}, "a cluster has another token, or none"
assert get_auth_headers_if_auth_enabled({}) == {}
assert tokens[0] != tokens[1] and len(tokens[0]) >= 32
"""


def run(script: str, home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a script with a home directory of its own, without Ray's variables for tokens."""
    inherited = {name: value for name, value in os.environ.items() if name not in TOKENS}
    done = subprocess.run(
        [sys.executable, "-c", START + script, *arguments],
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        cwd=home,
        env=inherited | {"HOME": str(home), "PYTHONPATH": str(Path(__file__).parents[3])},
    )
    assert done.returncode == 0, done.stderr
    return done


def test_it_listens_on_loopback_and_requires_its_token(tmp_path: Path) -> None:
    assert "a task ran" in run(LISTENERS, tmp_path).stdout
    assert not (tmp_path / ".ray").exists(), "Ray's own token would be readable by everybody"


@pytest.mark.slow
def test_it_starts_no_process_that_it_does_not_need(tmp_path: Path) -> None:
    assert "agents that survive the raylet: 0" in run(PROCESSES, tmp_path).stdout


@pytest.mark.slow
def test_a_waiting_worker_that_has_imported_a_module_becomes_an_actor(tmp_path: Path) -> None:
    assert "imported before: True" in run(WAITING_WORKERS, tmp_path).stdout


@pytest.mark.slow
def test_it_starts_while_its_agents_do_not_answer(tmp_path: Path) -> None:
    assert "a task ran while 1 agent is stopped" in run(SLOW_AGENTS, tmp_path).stdout


@pytest.mark.slow
def test_the_person_who_waits_is_told_for_what(tmp_path: Path) -> None:
    done = run(SLOW_RAYLET, tmp_path)
    assert "a task ran" in done.stdout
    assert "Waiting for Ray to start: its raylet has not registered after 0 s" in done.stderr


@pytest.mark.slow
def test_a_start_of_which_a_process_ends_is_repeated(tmp_path: Path) -> None:
    assert "a task ran after 1 was killed" in run(DEAD_RAYLETS, tmp_path, "1").stdout


@pytest.mark.slow
def test_a_process_that_always_ends_is_named(tmp_path: Path) -> None:
    assert "Ray did not start: its process raylet ended; see /" in run(DEAD_RAYLETS, tmp_path, "100").stdout


@pytest.mark.slow
def test_each_has_a_token_of_its_own(tmp_path: Path) -> None:
    assert run(TWICE, tmp_path).stdout.count("a task ran") == 2


@pytest.mark.parametrize(
    "chosen", [{token.TOKEN: "chosen"}, {token.TOKEN_FILE: "/home/me/token"}, {token.MODE: token.DISABLED}]
)
def test_a_choice_of_the_user_is_kept(chosen: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in TOKENS:
        monkeypatch.delenv(name, raising=False)
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    token.create_token()
    assert {name: os.environ[name] for name in TOKENS if name in os.environ} == {token.MODE: "token", **chosen}
