"""Libraries report their use and errors to nobody."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from league import REPORTS_OFF
from tests.support.cluster import machines
from tests.support.policies.foreign_graphs import foreign

ENVIRONMENT = {name: value for name, value in os.environ.items() if name not in REPORTS_OFF and name != "CI"}
"""ONNX Runtime reports nothing where CI is set."""
WAIT = 35
"""Seconds after which ONNX Runtime has sent its first report."""


def test_the_first_import_asks_libraries_to_report_nothing() -> None:
    program = "import json, os, league; print(json.dumps({name: os.environ[name] for name in league.REPORTS_OFF}))"

    def variables(**others: str) -> dict[str, str]:
        command = [sys.executable, "-c", program]
        output = subprocess.run(command, env=ENVIRONMENT | others, check=True, capture_output=True).stdout
        return dict(json.loads(output))

    assert variables() == REPORTS_OFF
    choices = {"RAY_USAGE_STATS_ENABLED": "1", "ORT_DISABLE_TELEMETRY": ""}
    assert variables(**choices) == REPORTS_OFF | choices


@pytest.mark.slow
def test_no_name_is_looked_up(tmp_path: Path) -> None:
    """The control shows that this test can fail: without the variable, ONNX Runtime asks for a name."""
    if (reason := machines.obstacle()) is not None:
        pytest.skip(reason)
    graph, home = tmp_path / "graph.onnx", tmp_path / "home"
    graph.write_bytes(foreign(18, 9))
    home.mkdir()

    apart = ("unshare", "--net", "--mount", "--fork", "--kill-child", sys.executable, "-m", "tests.support.name_server")

    def names(program: str) -> list[str]:
        process = subprocess.run(
            [*apart, sys.executable, "-c", program],
            env=ENVIRONMENT | {"HOME": str(home)},
            check=True,
            capture_output=True,
            text=True,
        )
        return list(json.loads(process.stdout.splitlines()[-1]))

    ours = f"""if True:
        import time
        from league.ray_cluster import ensure_local, ray_session
        import ray

        def work():
            from league.policies.onnx import open_session
            session = open_session(open({str(graph)!r}, "rb").read())
            time.sleep({WAIT})

        with ray_session():
            ensure_local(2)
            ray.get(ray.remote(work).remote())
    """
    assert names(ours) == []
    assert not (home / ".cache/Microsoft").exists()
    alone = f"import onnxruntime, time; onnxruntime.InferenceSession({str(graph)!r}); time.sleep({WAIT})"
    assert any(name.endswith("microsoft.com") for name in names(alone))
