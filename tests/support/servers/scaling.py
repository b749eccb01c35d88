"""Sets the number of replicas: `python -m tests.support.servers.scaling ADDRESS DEPLOY_YAML REPLICAS`."""

import os
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from league.ray_cluster import join
from serve_app.runtime.launch import load_document
from serve_app.runtime.ray_serve import deploy
from tests.support.servers.under_load import RayServer, processes

PREFIXES = ("RAY_SERVE_", "RAY_AUTH_", "LEAGUE_", "OMP_")
"""Environment variables that a driver must share with its cluster."""


def scale(server: RayServer, count: int) -> None:
    """Change the number of replicas."""
    (raylet,) = processes(server.registry.storage, "raylet")
    command = Path(f"/proc/{raylet}/cmdline").read_text()
    address = re.search(r"gcs-address=([\d.:]+)", command)
    assert address is not None, command
    replica_environment = _environment_of_any(processes(server.registry.storage, "PolicyServer"))
    shared = dict(line.split("=", 1) for line in replica_environment if line.startswith(PREFIXES))
    script = [sys.executable, "-m", "tests.support.servers.scaling", address[1], str(server.deploy), str(count)]
    subprocess.run(script, env=os.environ | shared, check=True, timeout=120, capture_output=True)


def _environment_of_any(replicas: list[int]) -> list[str]:
    """The environment of the first process that still runs: a replica may be replaced at any time."""
    for process in replicas:
        with suppress(FileNotFoundError, ProcessLookupError):
            return Path(f"/proc/{process}/environ").read_text().split("\0")
    raise AssertionError(f"none of {replicas} runs")


def main() -> None:
    address, deploy_yaml, count = sys.argv[1:]
    import ray
    from ray.serve.schema import ServeDeploySchema

    join(address, namespace="serve")
    schema = ServeDeploySchema.model_validate(
        load_document(Path(deploy_yaml), None, None, None, int(count), None, insecure=True)
    )
    deploy(schema)
    ray.shutdown()


if __name__ == "__main__":
    main()
