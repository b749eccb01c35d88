"""The deployment files agree with deploy.yaml, with the exported metrics, and with the documentation for operators."""

import json
import re
import subprocess
import sys
import tomllib
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.utils import canonicalize_name

from serve_app.observability.prometheus import METRICS
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
OPERATIONS = (ROOT / "docs/operations.md").read_text()


def exports() -> dict[str, str]:
    """The environment variables in the comments of deploy.yaml."""
    found = re.findall(r"^#\s+export (\w+)=(\"[^\"]*\"|\S+)", (ROOT / "deploy.yaml").read_text(), flags=re.M)
    return {name: value.strip('"') for name, value in found}


def test_the_cluster_serves_like_a_single_machine() -> None:
    expected = json.loads(json.dumps(DEPLOY))
    expected["http_options"]["host"] = "0.0.0.0"
    expected["applications"][0]["args"] |= {"grpc_local_only": False}
    expected["applications"][0]["deployments"][0]["num_replicas"] = 4
    assert expected == SERVED


@pytest.mark.parametrize("document", [DEPLOY, SERVED], ids=["deploy.yaml", "kuberay.yaml"])
def test_both_files_are_valid_for_ray_and_our_settings(document: Any) -> None:
    from ray.serve.schema import ServeDeploySchema

    ServeDeploySchema.model_validate(document)
    settings = ServeSettings.model_validate(document["applications"][0]["args"])
    deployment = document["applications"][0]["deployments"][0]
    assert deployment["graceful_shutdown_timeout_s"] >= 40
    assert settings.timeout < int(exports()["RAY_SERVE_HAPROXY_TIMEOUT_SERVER_S"])


@pytest.mark.parametrize("template", [HEAD, WORKERS["template"]], ids=["head", "workers"])
def test_each_pod_has_the_environment_the_files_and_the_image(template: Any) -> None:
    (container,) = template["spec"]["containers"]
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    expected = exports()
    assert {name: value for name, value in environment.items() if name in expected and name != "LEAGUE_HOME"} == {
        name: value
        for name, value in expected.items()
        if name not in ("LEAGUE_HOME", "RAY_AUTH_MODE")  # the operator sets the latter, with the token
    }
    assert CLUSTER["authOptions"] == {"mode": "token"}
    assert "LEAGUE_DATABASE_URL" in environment, "SQLite supports only one machine"
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


def test_the_pinned_ray_is_that_of_the_cluster() -> None:
    constraints = (ROOT / "constraints.txt").read_text()
    assert f"ray=={CLUSTER['rayVersion']}\n" in constraints


def test_draining_evicts_one_pod_at_a_time_after_its_requests() -> None:
    selector = BUDGET["spec"]["selector"]["matchLabels"]
    assert selector.items() <= WORKERS["template"]["metadata"]["labels"].items()
    assert BUDGET["spec"]["maxUnavailable"] < WORKERS["replicas"] == WORKERS["minReplicas"]
    deployment = SERVED["applications"][0]["deployments"][0]
    spec = WORKERS["template"]["spec"]
    assert spec["terminationGracePeriodSeconds"] > deployment["graceful_shutdown_timeout_s"]
    assert spec["containers"][0]["readinessProbe"]["httpGet"]["path"] == "/v1/health/ready"


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
    found: dict[str, tuple[str, ...]] = {}
    for name, metric in METRICS.items():
        labels = (*metric.labels, "replica")
        if metric.kind == "histogram":
            found |= {f"{name}_bucket": (*labels, "le"), f"{name}_sum": labels, f"{name}_count": labels}
        else:
            found[name] = labels
    return found


@pytest.mark.parametrize(("where", "query"), queries())
def test_each_query_uses_existing_metrics_and_labels(where: str, query: str) -> None:
    known = samples()
    used = re.findall(r"\b(league_\w+)", query)
    assert used or "up{" in query
    assert set(used) <= known.keys(), where
    for name, selector in re.findall(r"\b(league_\w+)\{([^}]*)\}", query):
        assert set(re.findall(r"(\w+)\s*=~?\"", selector)) <= set(known[name]), where
    grouped = chain.from_iterable(re.split(r",\s*", labels) for labels in re.findall(r"by \(([^)]*)\)", query))
    assert set(grouped) <= set(chain.from_iterable(known[name] for name in used)), where


def test_each_metric_is_on_the_dashboard_or_in_an_alert() -> None:
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
    documented = re.findall(r"^\| `(League\w+)` \|", OPERATIONS, flags=re.M)
    assert documented == [rule["alert"] for rule in RULES]
    assert all(rule["annotations"]["summary"] and rule["labels"]["severity"] for rule in RULES)


def test_each_metric_is_documented() -> None:
    assert set(re.findall(r"^\| `(league_\w+)` \|", OPERATIONS, flags=re.M)) == METRICS.keys()


def test_each_serving_setting_is_documented_with_its_default() -> None:
    rows = dict(re.findall(r"^\| `(\w+)` \| `(.*?)` \|", OPERATIONS, flags=re.M))
    defaults = {name: field.default for name, field in ServeSettings.model_fields.items()}
    assert {name: yaml.safe_load(value) for name, value in rows.items()} == defaults


JOB = yaml.safe_load((ROOT / "deploy/nightly/cronjob.yaml").read_text())
POD = JOB["spec"]["jobTemplate"]["spec"]["template"]["spec"]


def test_the_nightly_job_uses_the_registry_of_the_cluster() -> None:
    (container,) = POD["containers"]
    (server,) = HEAD["spec"]["containers"]
    assert container["image"] == server["image"]
    served = {entry["name"]: entry for entry in server["env"]}
    for entry in container["env"]:
        if entry["name"] in ("LEAGUE_HOME", "LEAGUE_ARTIFACTS", "LEAGUE_DATABASE_URL"):
            assert entry == served[entry["name"]]
    mounted = {mount["name"] for mount in container["volumeMounts"]}
    assert mounted == {volume["name"] for volume in POD["volumes"]}
    assert JOB["spec"]["concurrencyPolicy"] == "Forbid"


def test_schedulers_run_existing_commands_with_their_exit_codes() -> None:
    from cli.nightly import BUSY, FAULTS

    unit = (ROOT / "deploy/nightly/league-nightly.service").read_text()
    assert f"SuccessExitStatus={BUSY}\n" in unit
    (rule,) = [r for r in JOB["spec"]["jobTemplate"]["spec"]["podFailurePolicy"]["rules"] if "onExitCodes" in r]
    assert rule["onExitCodes"]["values"] == [FAULTS, 2]
    (line,) = [line for line in (ROOT / "deploy/nightly/crontab").read_text().splitlines() if line[:1].isdigit()]
    assert re.fullmatch(r"(\S+ ){5}cd .* \.venv/bin/league nightly >> .*", line)
    assert POD["containers"][0]["command"] == ["league", "nightly"]
    assert re.search(
        r"^OnCalendar=\*-\*-\* \d\d:\d\d$", (ROOT / "deploy/nightly/league-nightly.timer").read_text(), flags=re.M
    )


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TRAINING = {"onnx", "onnxscript", "tensorboard", "torch"}
"""Dependencies that only training imports."""


def test_the_server_image_has_all_dependencies_except_those_of_training() -> None:
    expected = [each for each in PROJECT["dependencies"] if re.split(r"\W", each)[0] not in TRAINING]
    expected = [each.replace("ray[rllib,serve,tune]", "ray[serve]") for each in expected]
    listed = (ROOT / "deploy/server-requirements.txt").read_text().splitlines()
    assert [line for line in listed if line[0] != "#"] == sorted(
        expected + PROJECT["optional-dependencies"]["postgres"] + PROJECT["optional-dependencies"]["object-store"]
    )


def test_serving_and_evaluation_import_no_dependency_of_training() -> None:
    program = """if True:
        import importlib, pkgutil, sys
        for package in ("league", "evaluation", "serve_app", "configs"):
            for module in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
                if not module.name.endswith(("__main__", ".env")):
                    importlib.import_module(module.name)
        print(*sys.modules)
    """
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert process.returncode == 0, process.stderr
    assert set(process.stdout.split()) & (TRAINING | {"ray.rllib", "ray.tune", "training"}) == set()


def test_the_container_images_have_the_deployed_tags() -> None:
    dockerfile = (ROOT / "Dockerfile").read_text()
    assert f"--target server --tag {HEAD['spec']['containers'][0]['image']} ." in dockerfile
    assert PROJECT["version"] in HEAD["spec"]["containers"][0]["image"]
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


@pytest.mark.parametrize("torch", ["-cpu", "-cuda"])
def test_the_lock_files_have_digests_of_all_pins(torch: str) -> None:
    found = locked("-build", "", torch)
    pinned = (line.partition("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if line[0] != "#")
    pins = {canonicalize_name(package): version for package, _, version in pinned}
    assert {package: found[package][0].partition("+")[0] for package in pins} == pins
    assert all(package.startswith(("nvidia-", "cuda-", "triton")) for package in found.keys() - pins.keys())
    for version, hashes in found.values():
        assert version
        assert hashes
        assert all(re.fullmatch("--hash=sha256:[0-9a-f]{64}", each) for each in hashes)


def test_packages_are_built_with_the_pinned_setuptools() -> None:
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    assert required == [f"setuptools=={locked('-build')['setuptools'][0]}"]
