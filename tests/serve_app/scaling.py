"""Another number of replicas for a server that runs: `python -m tests.serve_app.scaling GCS_ADDRESS REPLICAS`."""

import os
import re
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from serve_app.launch import DEPLOY_YAML, _document

TAKEN = ("RAY_SERVE_", "RAY_AUTH_", "LEAGUE_", "OMP_")
"""What a driver's environment must have in common with its cluster's."""


def scale(replicas: list[int], raylet: int, count: int) -> None:
    """Change the number of replicas, by their processes' ids and that of their raylet."""
    command = Path(f"/proc/{raylet}/cmdline").read_text()
    address = re.search(r"gcs-address=([\d.:]+)", command)
    assert address is not None, command
    of_replica = _environment_of_one(replicas)
    shared = dict(line.split("=", 1) for line in of_replica if line.startswith(TAKEN))
    script = [sys.executable, "-m", "tests.serve_app.scaling", address[1], str(count)]
    subprocess.run(script, env=os.environ | shared, check=True, timeout=120, capture_output=True)


def _environment_of_one(processes: list[int]) -> list[str]:
    """That of the first one that still runs: a replica may be replaced at any time."""
    for process in processes:
        with suppress(FileNotFoundError, ProcessLookupError):
            return Path(f"/proc/{process}/environ").read_text().split("\0")
    raise AssertionError(f"none of {processes} runs")


def main() -> None:
    address, count = sys.argv[1:]
    import ray
    from ray.serve._private.api import serve_start
    from ray.serve.schema import ServeDeploySchema

    ray.init(address=address, namespace="serve", log_to_driver=False)
    schema = ServeDeploySchema.model_validate(_document(DEPLOY_YAML, None, None, None, int(count), False))
    serve_start().deploy_apps(schema, _blocking=False)
    ray.shutdown()


if __name__ == "__main__":
    main()
