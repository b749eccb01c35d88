"""The deployment files agree with deploy.yaml, with the exported metrics, and with the documentation for operators."""

import gzip
import json
import re
import signal
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml
from packaging.utils import canonicalize_name

from league import REPORTS_OFF
from league.settings import Storage
from policy_league.configs.bundled import names
from policy_league_client import __version__
from scripts.without_trainer import without_trainer
from serve_app.observability.prometheus import METRICS
from serve_app.runtime import haproxy_script
from serve_app.settings import ServeSettings

ROOT = Path(__file__).parent.parent
DEPLOY = yaml.safe_load((ROOT / "deploy.yaml").read_text())
SERVICE, BUDGET = yaml.safe_load_all((ROOT / "deploy/kuberay.yaml").read_text())
SERVED = yaml.safe_load(SERVICE["spec"]["serveConfigV2"])
CLUSTER = SERVICE["spec"]["rayClusterConfig"]
HEAD = CLUSTER["headGroupSpec"]["template"]
(WORKERS,) = CLUSTER["workerGroupSpecs"]
RULES = [
    rule
    for group in yaml.safe_load((ROOT / "deploy/prometheus-rules.yaml").read_text())["groups"]
    for rule in group["rules"]
]
DASHBOARD = json.loads((ROOT / "deploy/grafana/policy-league.json").read_text())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
IMAGES = tuple(f"{name}:{__version__}" for name in ("policy-league", "policy-league-trainer"))
OPERATIONS, MONITORING, SETTINGS = (
    (ROOT / f"docs/{page}.md").read_text() for page in ("operations", "monitoring", "server-settings")
)


def exports() -> dict[str, str]:
    """The environment variables in the comments of deploy.yaml."""
    lines = re.findall(r"^#\s+export (\w+)=(\"[^\"]*\"|\S+)", (ROOT / "deploy.yaml").read_text(), flags=re.M)
    return {name: value.strip('"') for name, value in lines}


def test_the_cluster_serves_like_a_single_machine() -> None:
    expected = json.loads(json.dumps(DEPLOY))
    expected["http_options"]["host"] = "0.0.0.0"
    expected["applications"][0]["args"] |= {"grpc_local_only": False}
    deployment = expected["applications"][0]["deployments"][0] | {"max_replicas_per_node": 3}
    deployment["autoscaling_config"] |= {"min_replicas": 4, "max_replicas": 6}
    expected["applications"][0]["deployments"] = [deployment]
    assert expected == SERVED


def test_both_files_are_valid_for_ray_and_our_settings() -> None:
    from ray.serve.schema import ServeDeploySchema

    for document in (DEPLOY, SERVED):
        ServeDeploySchema.model_validate(document)
        settings = ServeSettings.model_validate(document["applications"][0]["args"])
        assert document["applications"][0]["deployments"][0]["graceful_shutdown_timeout_s"] >= 40
        assert settings.timeout < int(exports()["RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S"])


@pytest.mark.parametrize("template", [HEAD, WORKERS["template"]], ids=["head", "workers"])
def test_each_pod_has_the_environment_the_files_and_the_image(template: Any) -> None:
    (container,) = template["spec"]["containers"]
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    expected = exports() | {"RAY_SERVE_HAPROXY_BINARY_PATH": f"/opt/league/bin/{HAPROXY}"}
    assert {name: value for name, value in environment.items() if name in expected and name != "LEAGUE_HOME"} == {
        name: value
        for name, value in expected.items()
        if name not in ("LEAGUE_HOME", "RAY_AUTH_MODE")  # the operator sets the latter, with the token
    }
    assert CLUSTER["authOptions"] == {"mode": "token"}
    storage_of(container).check_reach({"10.0.0.1", "10.0.0.2"})
    assert container["image"] in IMAGES
    mounts = {mount["mountPath"]: mount for mount in container["volumeMounts"]}
    volumes = {volume["name"]: volume for volume in template["spec"]["volumes"]}
    assert {mount["name"] for mount in mounts.values()} == volumes.keys()
    store, home = (
        mounts[str(Path(str(environment["LEAGUE_ARTIFACTS"])).parent)],
        mounts[str(environment["LEAGUE_HOME"])],
    )
    assert store["readOnly"]
    assert volumes[store["name"]]["persistentVolumeClaim"]["readOnly"]
    assert not home.get("readOnly")
    assert volumes[home["name"]] == {"name": "home", "emptyDir": {}}, "each pod has its own"
    assert {port["containerPort"] for port in container["ports"]} == {8000, 8001}
    assert container["image"] == HEAD["spec"]["containers"][0]["image"]


def storage_of(container: Any) -> Storage:
    """The storage that a container's environment describes. The database's URL is a secret."""
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    (url,) = [entry for entry in container["env"] if entry["name"] == "LEAGUE_DATABASE_URL"]
    assert url["valueFrom"] == {"secretKeyRef": {"name": "policy-league", "key": "database-url"}}
    home, artifacts = (Path(str(environment[name])) for name in ("LEAGUE_HOME", "LEAGUE_ARTIFACTS"))
    return Storage(home, "postgresql+psycopg://database/league", artifacts)


KUBERNETES = json.loads(gzip.decompress((ROOT / "tests/data/kubernetes.json.gz").read_bytes()))
OBJECTS = [
    document
    for file in ("kuberay.yaml", "nightly/cronjob.yaml", "nightly/training-cronjob.yaml")
    for document in yaml.safe_load_all((ROOT / "deploy" / file).read_text())
]
ELASTIC = yaml.safe_load((ROOT / "deploy/kuberay-training.yaml").read_text())
ELASTIC_HEAD = ELASTIC["spec"]["headGroupSpec"]["template"]["spec"]
(ELASTIC_WORKERS,) = ELASTIC["spec"]["workerGroupSpecs"]
ELASTIC_PODS = [ELASTIC_HEAD, ELASTIC_WORKERS["template"]["spec"]]


def schema_of(kind: str) -> Any:
    """A RayCluster has the fields of the cluster of a RayService."""
    kinds = KUBERNETES["kinds"]
    if kind != "RayCluster":
        return kinds[kind]
    service = kinds["RayService"]
    cluster = service["properties"]["spec"]["properties"]["rayClusterConfig"]
    return service | {"properties": service["properties"] | {"spec": cluster}}


def faults(document: Any) -> list[str]:
    """Where a Kubernetes object differs from the schema of its kind. Unknown fields are faults."""
    schema = schema_of(document["kind"]) | {"$defs": KUBERNETES["$defs"]}
    errors = jsonschema.Draft202012Validator(schema).iter_errors(document)
    return [f"{error.json_path}: {error.message}" for error in errors]


def test_kubernetes_accepts_the_objects_and_no_unknown_field() -> None:
    assert [fault for document in (*OBJECTS, ELASTIC) for fault in faults(document)] == []
    service, job = (json.loads(json.dumps(document)) for document in (OBJECTS[0], OBJECTS[-1]))
    service["spec"]["rayClusterConfig"]["headGroupSpec"]["template"]["spec"]["containers"][0]["volumes"] = []
    job["spec"]["jobTemplate"]["spec"]["template"]["spec"]["securityContext"]["runAs"] = 1000
    assert ["volumes" in fault for fault in faults(service)] == [True]
    assert ["runAs" in fault for fault in faults(job)] == [True]


POD_SPECS = [
    HEAD["spec"],
    WORKERS["template"]["spec"],
    *(o["spec"]["jobTemplate"]["spec"]["template"]["spec"] for o in OBJECTS[2:]),
    *ELASTIC_PODS,
]


def test_pods_run_as_the_user_of_the_image() -> None:
    ((uid, gid),) = re.findall(r"^USER (\d+):(\d+)$", (ROOT / "Dockerfile").read_text(), flags=re.M)
    user = {"runAsNonRoot": True, "runAsUser": int(uid), "runAsGroup": int(gid), "fsGroup": int(gid)}
    assert [spec["securityContext"] | user for spec in POD_SPECS] == [spec["securityContext"] for spec in POD_SPECS]


HAPROXY = "league-haproxy"


def test_the_limits_of_haproxy_apply_wherever_serve_runs() -> None:
    """Ray sets neither a limit for slow senders nor a timeout for idle WebSockets: its HAProxy is our wrapper."""
    assert PROJECT["scripts"][HAPROXY] == f"{haproxy_script.__name__}:main"
    assert exports()["RAY_SERVE_HAPROXY_BINARY_PATH"] == f"$(command -v {HAPROXY})"
    assert f"python -m venv {Path(POD_HAPROXY).parents[1]}" in (ROOT / "Dockerfile").read_text()


(POD_HAPROXY,) = (
    entry["value"] for entry in HEAD["spec"]["containers"][0]["env"] if entry["name"] == "RAY_SERVE_HAPROXY_BINARY_PATH"
)


def test_the_cluster_survives_the_loss_of_its_head_and_of_a_pod() -> None:
    assert CLUSTER["gcsFaultToleranceOptions"]["redisAddress"]
    assert SERVICE["spec"]["excludeHeadPodFromServeSvc"]
    assert CLUSTER["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    deployment = SERVED["applications"][0]["deployments"][0]
    replicas, of_a_pod = deployment["autoscaling_config"], deployment["max_replicas_per_node"]
    assert replicas["max_replicas"] / WORKERS["replicas"] <= of_a_pod
    assert of_a_pod < replicas["min_replicas"]


def test_the_pinned_ray_is_that_of_the_cluster() -> None:
    constraints = (ROOT / "constraints.txt").read_text()
    assert f"ray=={CLUSTER['rayVersion']}\n" in constraints


def test_draining_evicts_one_pod_at_a_time_after_its_requests() -> None:
    selector = BUDGET["spec"]["selector"]["matchLabels"]
    assert selector.items() <= WORKERS["template"]["metadata"]["labels"].items()
    assert BUDGET["spec"]["maxUnavailable"] < WORKERS["replicas"] == WORKERS["minReplicas"]
    deployment = SERVED["applications"][0]["deployments"][0]
    spec = WORKERS["template"]["spec"]
    drain = float(exports()["RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S"])
    assert spec["terminationGracePeriodSeconds"] > drain > deployment["graceful_shutdown_timeout_s"]
    assert spec["containers"][0]["readinessProbe"]["httpGet"]["path"] == "/v1/health/ready"


def test_the_autoscaler_adds_and_removes_nodes_for_training() -> None:
    """`league` recognises version 2 of the autoscaler only."""
    spec = ELASTIC["spec"]
    assert spec["enableInTreeAutoscaling"]
    assert spec["autoscalerOptions"]["version"] == "v2"
    assert spec["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    assert ELASTIC_WORKERS["minReplicas"] == 0 < ELASTIC_WORKERS["maxReplicas"]
    assert f"ray=={spec['rayVersion']}\n" in (ROOT / "constraints.txt").read_text()


@pytest.mark.parametrize("pod", ELASTIC_PODS, ids=["head", "workers"])
def test_the_nodes_for_training_share_storage_and_finish_when_they_are_preempted(pod: Any) -> None:
    (container,) = pod["containers"]
    assert container["image"] == f"policy-league-trainer:{__version__}"
    storage_of(container).check_reach({"10.0.0.1", "10.0.0.2"})
    assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
    assert not any(mount.get("readOnly") for mount in container["volumeMounts"])
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    grace = ELASTIC_WORKERS["template"]["spec"]["terminationGracePeriodSeconds"]
    assert float(str(environment["RAY_GRACEFUL_SHUTDOWN_DRAIN_TIMEOUT_S"])) < grace


def queries() -> list[tuple[str, str]]:
    """(panel or alert, query) of the dashboard and the alerts."""
    panels = [(panel["title"], target["expr"]) for panel in DASHBOARD["panels"] for target in panel["targets"]]
    variables = [
        (variable["name"], variable["query"])
        for variable in DASHBOARD["templating"]["list"]
        if variable["type"] == "query"
    ]
    return [*panels, *variables, *((rule["alert"], rule["expr"]) for rule in RULES)]


def samples() -> dict[str, tuple[str, ...]]:
    """Name of each sample in the exposition → its labels."""
    labels_of_samples: dict[str, tuple[str, ...]] = {}
    for name, metric in METRICS.items():
        labels = (*metric.labels, "replica")
        if metric.kind == "histogram":
            labels_of_samples |= {f"{name}_bucket": (*labels, "le"), f"{name}_sum": labels, f"{name}_count": labels}
        else:
            labels_of_samples[name] = labels
    return labels_of_samples


def test_queries_use_existing_metrics_and_labels_and_each_metric_is_used() -> None:
    labels_of = samples()
    for place, query in queries():
        metrics = re.findall(r"\b(league_\w+)", query)
        assert metrics or "up{" in query, place
        assert set(metrics) <= labels_of.keys(), place
        for name, selector in re.findall(r"\b(league_\w+)\{([^}]*)\}", query):
            assert set(re.findall(r"(\w+)\s*=~?\"", selector)) <= set(labels_of[name]), place
        grouped = chain.from_iterable(re.split(r",\s*", labels) for labels in re.findall(r"by \(([^)]*)\)", query))
        assert set(grouped) <= set(chain.from_iterable(labels_of[name] for name in metrics)), place
    expressions = " ".join(query for _, query in queries())
    assert {name for name in METRICS if name not in expressions} == set()


def test_panels_do_not_overlap() -> None:
    cells = [
        (x, y)
        for panel in DASHBOARD["panels"]
        for place in [panel["gridPos"]]
        for x in range(place["x"], place["x"] + place["w"])
        for y in range(place["y"], place["y"] + place["h"])
    ]
    assert len(set(cells)) == len(cells)
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])


def test_each_alert_is_documented() -> None:
    documented = re.findall(r"^\| `(League\w+)` \|", MONITORING, flags=re.M)
    assert documented == [rule["alert"] for rule in RULES]
    assert all(rule["annotations"]["summary"] and rule["labels"]["severity"] for rule in RULES)


def test_each_metric_and_serving_setting_is_documented() -> None:
    assert set(re.findall(r"^\| `(league_\w+)` \|", MONITORING, flags=re.M)) == METRICS.keys()
    rows = dict(re.findall(r"^\| `(\w+)` \| `(.*?)` \|", SETTINGS, flags=re.M))
    defaults = {name: field.default for name, field in ServeSettings.model_fields.items()}
    assert {name: yaml.safe_load(value) for name, value in rows.items()} == defaults


JOBS = OBJECTS[2:]
NIGHTLY = ["league", "nightly"]
TRAINING_NIGHT = [*NIGHTLY, "--train", "connect_four", "leduc_holdem"]
WITHOUT_TRAINING = [*NIGHTLY, "connect_four"]


@pytest.mark.parametrize(
    ("job", "command"), zip(JOBS, [WITHOUT_TRAINING, TRAINING_NIGHT], strict=True), ids=["nightly", "training night"]
)
def test_the_nightly_jobs_use_the_registry_of_the_cluster(job: Any, command: list[str]) -> None:
    pod = job["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    (server,) = HEAD["spec"]["containers"]
    assert container["command"] == command
    assert container["image"] in IMAGES
    served = storage_of(server)
    storage = storage_of(container)
    assert (storage.database_url, storage.artifacts) == (served.database_url, served.artifacts)
    storage.check_reach({"10.0.0.1", "10.0.0.2"})
    mounted = {mount["name"] for mount in container["volumeMounts"]}
    assert mounted == {volume["name"] for volume in pod["volumes"]}
    assert job["spec"]["concurrencyPolicy"] == "Forbid"


def test_a_training_night_writes_versions_and_keeps_its_runs_on_the_volume() -> None:
    pod = JOBS[1]["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    (mount,) = [mount for mount in container["volumeMounts"] if mount["name"] == "league"]
    storage = storage_of(container)
    assert not mount.get("readOnly")
    assert isinstance(storage.artifacts, Path)
    assert all(path.is_relative_to(mount["mountPath"]) for path in (storage.home, storage.artifacts))
    assert set(TRAINING_NIGHT[3:]) <= set(names())
    assert "trainer" in container["image"], "the server's image has no PyTorch"
    assert pod["terminationGracePeriodSeconds"] >= 120, "training ends after an update, and is published"


@pytest.mark.parametrize("league", WITHOUT_TRAINING[2:])
def test_the_job_without_training_runs_leagues_that_the_image_of_the_server_can_test(league: str) -> None:
    program = f"""if True:
        import sys
        for name in {sorted(ONLY_IN_TRAINER)}:
            sys.modules[name] = None  # imports of it fail
        from policy_league.configs.bundled import find
        from league.config.league import LeagueConfig
        from league.environments.building import interface
        from league.policies.loading import configured_contestants
        config = LeagueConfig.load(find({league!r}))
        interface(config)
        assert not config.gate.exploiters.count and not configured_contestants(config)
    """
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr


MEMORY = {"Gi": 2**30, "Mi": 2**20}


def size(quantity: str) -> int:
    return int(quantity[:-2]) * MEMORY[quantity[-2:]]


def test_shared_memory_holds_the_object_store_of_ray() -> None:
    """Otherwise Ray uses the container's disk."""
    from ray._private.ray_constants import DEFAULT_OBJECT_STORE_MEMORY_PROPORTION

    for pod in POD_SPECS[2:]:
        (container,) = pod["containers"]
        (volume,) = [volume["emptyDir"] for volume in pod["volumes"] if volume["name"] == "shared-memory"]
        limit = size(container["resources"]["limits"]["memory"])
        assert volume["medium"] == "Memory"
        assert DEFAULT_OBJECT_STORE_MEMORY_PROPORTION * limit < size(volume["sizeLimit"]) < limit


def test_schedulers_run_existing_commands_with_their_exit_codes() -> None:
    from policy_league.cli.evaluation.nightly import BUSY
    from policy_league.cli.main import FAILURE

    for job, if_busy in zip(JOBS, ("Ignore", "Count"), strict=True):
        rules = [r for r in job["spec"]["jobTemplate"]["spec"]["podFailurePolicy"]["rules"] if "onExitCodes" in r]
        actions = {tuple(rule["onExitCodes"]["values"]): rule["action"] for rule in rules}
        assert actions == {(FAILURE, 2): "FailJob", (BUSY,): if_busy}
    crontab = (ROOT / "deploy/nightly/crontab").read_text()
    for unit, command in ("league-nightly", NIGHTLY), ("league-training-night", TRAINING_NIGHT):
        service, timer = ((ROOT / f"deploy/nightly/{unit}.{kind}").read_text() for kind in ("service", "timer"))
        assert f"SuccessExitStatus={BUSY} {128 + signal.SIGINT} {128 + signal.SIGTERM}\n" in service
        assert "\nKillMode=mixed\n" in service, "a signal to Ray's processes would end training before it is saved"
        assert re.search(rf"^ExecStart=\S+/\.venv/bin/{' '.join(command)}$", service, flags=re.M)
        assert re.search(r"^OnCalendar=\*-\*-\* \d\d:\d\d$", timer, flags=re.M)
        assert re.search(rf"^(\S+ ){{5}}cd .* \.venv/bin/{' '.join(command)} >> ", crontab, flags=re.M)


TRAINING = {"onnx", "onnxscript", "ray.rllib", "ray.tune", "tensorboard", "torch"}
"""Modules of dependencies that only training imports."""
TRAINER_EXTRAS = ["environments", "object-store", "openspiel", "optuna", "postgres"]
ONLY_IN_TRAINER = {*TRAINING, "pyspiel", "rlcard"}
"""Modules that the server's image lacks."""


def test_the_trainer_image_has_the_documented_extras() -> None:
    _, extras = re.findall(r"\$\{wheel\}\[(\S+)\]", (ROOT / "Dockerfile").read_text())
    assert extras.split(",") == TRAINER_EXTRAS
    assert set(TRAINER_EXTRAS) <= PROJECT["optional-dependencies"].keys()
    (documented,) = re.findall(r"`trainer` also trains, and has the extras\s+([^.]*)\.", OPERATIONS)
    assert re.findall(r"`([\w-]+)`", documented) == TRAINER_EXTRAS


def test_the_server_image_lacks_only_the_dependencies_of_training() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    remaining = tomllib.loads(without_trainer(text))["project"]
    names = {re.split(r"[<>=]", line)[0] for line in set(PROJECT["dependencies"]) - set(remaining["dependencies"])}
    assert names == {"onnx", "onnxscript", "ray[rllib,tune]", "tensorboard", "torch"}
    assert remaining | {"dependencies": PROJECT["dependencies"]} == PROJECT


def test_serving_and_evaluation_import_no_dependency_of_training() -> None:
    program = """if True:
        import importlib, pkgutil, sys
        for package in ("league", "evaluation", "serve_app", "policy_league.configs"):
            for module in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
                if not module.name.endswith(("__main__", ".env")):
                    importlib.import_module(module.name)
        print(*sys.modules)
    """
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr
    assert set(process.stdout.split()) & (TRAINING | {"training"}) == set()


def test_libraries_report_their_use_nowhere() -> None:
    for file in ("deploy.yaml", "deploy/kuberay.yaml", "deploy/kuberay-training.yaml", "Dockerfile"):
        text = (ROOT / file).read_text()
        for name in ("ORT_DISABLE_TELEMETRY", "RAY_USAGE_STATS_ENABLED"):
            assert re.search(rf'{name}(=|, value: ")({REPORTS_OFF[name]})\b', text), file


def test_the_container_images_have_the_deployed_tags() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    for target, image in zip(("server", "trainer"), IMAGES, strict=True):
        assert f"--target {target} --tag {image} ." in dockerfile
    assert set(re.findall(r"^FROM \S+ AS (\w+)$", dockerfile, flags=re.M)) >= {"server", "trainer"}
    assert re.search(r"^USER 1000:1000$", dockerfile, flags=re.M), "Kubernetes checks that the user is not root"


def locked(*names: str) -> dict[str, tuple[str, list[str]]]:
    """Package → its version and digests in these lock files."""
    pins = {}
    for name in names:
        text = (ROOT / "requirements" / f"linux-x86_64{name}.txt").read_text().replace("\\\n", "")
        for line in text.splitlines():
            if not line.startswith("#"):
                pin, *hashes = line.split()
                package, _, version = pin.partition("==")
                pins[package] = version, hashes
    return pins


def test_the_lock_files_have_digests_of_all_pins_which_build_with_the_pinned_setuptools() -> None:
    pinned = (line.partition("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if line[0] != "#")
    pins = {canonicalize_name(package): version for package, _, version in pinned}
    for torch in ("-cpu", "-cuda"):
        packages = locked("-build", "", torch)
        assert {package: packages[package][0].partition("+")[0] for package in pins} == pins
        assert all(package.startswith(("nvidia-", "cuda-", "triton")) for package in packages.keys() - pins.keys())
        for version, hashes in packages.values():
            assert version
            assert hashes
            assert all(re.fullmatch("--hash=sha256:[0-9a-f]{64}", digest) for digest in hashes)
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert required == [f"setuptools=={locked('-build')['setuptools'][0]}"]
