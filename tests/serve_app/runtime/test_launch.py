"""Faults are reported in one sentence before Ray starts."""

import socket
from pathlib import Path
from typing import Any

import pytest
import yaml

from league.errors import AlreadyRunning, ConfigError, NotReady, StorageError
from league.settings import Storage
from serve_app.runtime import launch
from serve_app.runtime.launch import DEPLOY_YAML, load_document, running
from tests.support.waiting import until


@pytest.mark.parametrize("which", ["port", "grpc_port"])
def test_a_port_in_use_is_reported(storage: Storage, which: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with (
            pytest.raises(AlreadyRunning, match=f"port {port} of 127.0.0.1 is in use"),
            running(storage, **{which: port}),  # type: ignore[arg-type]
        ):
            pass


def test_invalid_settings_are_reported(storage: Storage, tmp_path: Path) -> None:
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(DEPLOY_YAML.read_text().replace("    args:\n", "    args:\n      max_body: 1\n"))
    with pytest.raises(ConfigError, match="max_body"), running(storage, deploy=deploy):
        pass


@pytest.mark.parametrize("text", ["", "applications: []", "http_options: {}", "a: [", "- 1"])
def test_an_invalid_deploy_yaml_is_reported(tmp_path: Path, text: str) -> None:
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(text)
    with pytest.raises(ConfigError, match=r"deploy\.yaml"):
        load_document(deploy, None, None, None, None, None, insecure=False)


def test_a_missing_deploy_yaml_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"):
        load_document(tmp_path / "nowhere.yaml", None, None, None, None, None, insecure=False)


def test_an_unusable_home_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(StorageError, match="file"), running(Storage.at(tmp_path / "file" / "home")):
        pass


@pytest.mark.parametrize(
    ("replicas", "max_replicas", "expected"),
    [(None, None, (2, 2)), (3, None, (3, 3)), (1, 4, (1, 4)), (None, 5, (2, 5))],
)
def test_the_options_set_the_bounds_of_the_number_of_replicas(
    replicas: int | None, max_replicas: int | None, expected: tuple[int, int]
) -> None:
    document = load_document(DEPLOY_YAML, None, None, None, replicas, max_replicas, insecure=False)
    bounds = document["applications"][0]["deployments"][0]["autoscaling_config"]
    assert (bounds["min_replicas"], bounds["max_replicas"]) == expected


@pytest.mark.parametrize(
    ("replicas", "max_replicas", "message"),
    [
        (3, 2, "--max-replicas must be at least 3, as --replicas or min_replicas, got 2"),
        (None, 1, "--max-replicas must be at least 2, as --replicas or min_replicas, got 1"),
        (0, 2, "min_replicas must be at least 1, got 0"),
    ],
)
def test_impossible_numbers_of_replicas_are_reported(replicas: int | None, max_replicas: int, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_document(DEPLOY_YAML, None, None, None, replicas, max_replicas, insecure=False)


def test_a_deploy_yaml_may_have_a_fixed_number_of_replicas(tmp_path: Path) -> None:
    document = yaml.safe_load(DEPLOY_YAML.read_text())
    deployment = document["applications"][0]["deployments"][0]
    del deployment["autoscaling_config"]
    deployment["num_replicas"] = 2
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(yaml.safe_dump(document))
    loaded = load_document(deploy, None, None, None, 3, None, insecure=False)
    assert loaded["applications"][0]["deployments"][0]["num_replicas"] == 3
    with pytest.raises(ConfigError, match=r"--max-replicas: deploy\.yaml has num_replicas"):
        load_document(deploy, None, None, None, None, 3, insecure=False)


def test_an_impossible_target_is_reported(tmp_path: Path) -> None:
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(DEPLOY_YAML.read_text().replace("target: 0.6", "target: 60"))
    with pytest.raises(ConfigError, match="target must be greater than 0 and less than 1, got 60"):
        load_document(deploy, None, None, None, None, None, insecure=False)


def test_a_missing_haproxy_is_reported(storage: Storage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_SERVE_HAPROXY_BINARY_PATH", "/nowhere/haproxy")
    with pytest.raises(NotReady, match="HAProxy is missing"), running(storage):
        pass


def test_a_password_is_in_no_command_line(tmp_path: Path) -> None:
    storage = Storage(tmp_path, "postgresql://league:secret@192.0.2.1/league", tmp_path / "artifacts")
    commands = []

    class Recorded(launch.Subprocess):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            # The command line is set shortly after the constructor returns.
            until(Path(f"/proc/{self.pid}/cmdline").read_text)
            commands.append(Path(f"/proc/{self.pid}/cmdline").read_text())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(launch, "Subprocess", Recorded)
        with pytest.raises(ConfigError, match="none"), running(storage, deploy=tmp_path / "none.yaml"):
            pass
    (command,) = commands
    assert "serve_app.runtime.launch" in command
    assert "secret" not in command


def test_a_password_is_not_given_to_a_cluster(tmp_path: Path) -> None:
    storage = Storage(tmp_path, "postgresql://league:secret@192.0.2.1/league", tmp_path / "artifacts")
    with pytest.raises(ConfigError, match="LEAGUE_DATABASE_URL contains a password"):
        launch._serve_on_cluster("127.0.0.1:9", storage, {}, None)
