"""A node of a cluster starts HAProxy by `league-haproxy`, with the same limits as `league serve`."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from serve_app.runtime import haproxy_script

COMMAND = str(Path(sys.executable).with_name(haproxy_script.COMMAND))
NODE = os.environ | {haproxy_script.BINARY_PATH: COMMAND}
"""The environment of a node, in which Ray's HAProxy is the command itself."""
CONFIGURATION = """global
    maxconn 16384
defaults
    mode http
    timeout client 60s
    timeout connect 5s
    timeout server 5s
frontend prometheus
    bind :{metrics}
frontend http_frontend
    bind 127.0.0.1:1
listen stats
    bind *:{stats}
"""


def check(configuration: Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    """Let HAProxy check a configuration: `-c` starts nothing."""
    command = [COMMAND, "-db", "-f", str(configuration), "-c"]
    return subprocess.run(command, env=NODE | environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("environment", "stats", "metrics"),
    [
        ({}, 8404, 9101),
        ({"RAY_SERVE_HAPROXY_STATS_PORT": "8500", "RAY_SERVE_HAPROXY_METRICS_PORT": "8501"}, 8500, 8501),
    ],
    ids=["ports of Ray", "other ports"],
)
def test_a_node_has_the_limits(environment: dict[str, str], stats: int, metrics: int, tmp_path: Path) -> None:
    configuration = tmp_path / "haproxy.cfg"
    configuration.write_text(CONFIGURATION.format(stats=stats, metrics=metrics))
    checked = check(configuration, **environment)
    assert checked.returncode == 0, checked.stderr
    amended = configuration.read_text()
    assert "timeout tunnel 3600s" in amended, "idle WebSockets would end with the timeout of a request"
    assert "timeout http-request 10s" in amended
    assert "option http-buffer-request" in amended
    assert f"bind 127.0.0.1:{stats}" in amended, "statistics are for this machine only"
    assert f"bind 127.0.0.1:{metrics}" in amended


@pytest.mark.parametrize(("descriptors", "connections"), [(1_000, 320), (20_000, 7_920), (50_000, 16_384)])
def test_a_node_accepts_the_connections_for_which_it_has_descriptors(
    descriptors: int, connections: int, tmp_path: Path
) -> None:
    configuration = tmp_path / "haproxy.cfg"
    configuration.write_text(CONFIGURATION.format(stats=8404, metrics=9101))
    (tmp_path / "binary").write_text("#!/bin/sh\n")
    (tmp_path / "binary").chmod(0o700)
    wrapper = haproxy_script.install(tmp_path, str(tmp_path / "binary"), 8404, 9101)
    # A limit can only be lowered: the shell reports the one of the test.
    shell = f"ulimit() {{ echo {descriptors}; }}\n"
    wrapper.write_text(wrapper.read_text().replace("\n", f"\n{shell}", 1))
    subprocess.run([str(wrapper), "-f", str(configuration)], check=True, timeout=60)
    assert f"    maxconn {connections}\n" in configuration.read_text()


def test_options_without_a_configuration_are_passed_on() -> None:
    shown = subprocess.run([COMMAND, "-v"], env=NODE, capture_output=True, text=True, timeout=60)
    assert shown.returncode == 0
    assert shown.stdout.startswith("HAProxy version")
