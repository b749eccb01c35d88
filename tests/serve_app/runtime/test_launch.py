"""Faults are reported in one sentence before Ray starts."""

import socket
from pathlib import Path
from typing import Any

import pytest

from league.errors import AlreadyRunning, ConfigError, NotReady, StorageError
from league.settings import Storage
from serve_app.runtime import launch
from serve_app.runtime.launch import DEPLOY_YAML, running
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
def test_an_invalid_deploy_yaml_is_reported(storage: Storage, tmp_path: Path, text: str) -> None:
    deploy = tmp_path / "deploy.yaml"
    deploy.write_text(text)
    with pytest.raises(ConfigError, match=r"deploy\.yaml"), running(storage, deploy=deploy):
        pass


def test_a_missing_deploy_yaml_is_reported(storage: Storage, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml"), running(storage, deploy=tmp_path / "nowhere.yaml"):
        pass


def test_an_unusable_home_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(StorageError, match="file"), running(Storage.at(tmp_path / "file" / "home")):
        pass


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
