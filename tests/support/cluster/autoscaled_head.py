"""A head whose autoscaler is Ray's own. The nodes that it adds are processes of the same machine."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ray.autoscaler._private.fake_multi_node.node_provider import FAKE_HEAD_NODE_ID, FakeMultiNodeProvider

from tests.support.cluster.league_cluster import OBJECT_STORE, RAY, START_TIMEOUT
from tests.support.cluster.machines import Machine

CPUS = 2
"""Of each node."""
MAX_NODES = 2
HEAD_TYPE = "ray.head.default"
"""As the provider calls it."""
COMMANDS = ("initialization", "setup", "head_setup", "worker_setup", "head_start_ray", "worker_start_ray")
ENVIRONMENT = {
    "AUTOSCALER_UPDATE_INTERVAL_S": "1",
    "RAY_FAKE_CLUSTER": "1",
    "RAY_enable_autoscaler_v2": "1",
    "RAY_CLOUD_INSTANCE_ID": FAKE_HEAD_NODE_ID,
    "RAY_OVERRIDE_NODE_ID_FOR_TESTING": FAKE_HEAD_NODE_ID,
}


def start(machine: Machine, file: Path, environment: Mapping[str, str]) -> None:
    """Start the head without CPUs and without other nodes. file: for the autoscaler's configuration."""
    file.write_text(json.dumps(_configuration()))
    options = ("--port", "6379", "--num-cpus", "0", "--include-dashboard", "false", "--disable-usage-stats")
    memory = ("--object-store-memory", str(OBJECT_STORE), "--node-ip-address", machine.address)
    command = (RAY, "start", "--head", *options, *memory, "--autoscaling-config", str(file))
    machine.check_run(*command, environment={**environment, **ENVIRONMENT}, timeout=START_TIMEOUT)


def _configuration() -> dict[str, Any]:
    provider = f"{FakeMultiNodeProvider.__module__}.{FakeMultiNodeProvider.__name__}"
    head = {"resources": {"CPU": 0}, "node_config": {}, "max_workers": 0}
    worker = {"resources": {"CPU": CPUS, "object_store_memory": OBJECT_STORE}, "node_config": {}}
    return {
        "cluster_name": "test",
        "max_workers": MAX_NODES,
        # `external`: the provider's own type needs a file that Ray's wheel does not contain.
        "provider": {
            "type": "external",
            "module": provider,
            "launch_multiple": True,
            "head_node_id": FAKE_HEAD_NODE_ID,
        },
        "available_node_types": {HEAD_TYPE: head, "worker": worker | {"min_workers": 0, "max_workers": MAX_NODES}},
        "head_node_type": HEAD_TYPE,
        "auth": {},
        "docker": {},
        "file_mounts": {},
        "cluster_synced_files": [],
        "file_mounts_sync_continuously": False,
        "rsync_exclude": [],
        "rsync_filter": [],
        **{f"{name}_commands": [] for name in COMMANDS},
    }
