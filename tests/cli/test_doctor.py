import socket
from pathlib import Path

import pytest

from policy_league.cli import doctor
from serve_app.runtime import launch
from tests.support.command import League


@pytest.mark.slow
def test_all_checks_of_doctor_pass(league_process: League) -> None:
    result = league_process("doctor", "--json")
    document = result.json
    found = {check["what"]: check["status"] for check in document["checks"]}
    assert {"Python", "ray", "torch", "CPU", "GPU", "LEAGUE_HOME", "disk", "registry", "Ray", "HAProxy"} <= set(found)
    assert document["ok"], document
    assert result.code == 0


def test_doctor_explains_a_broken_home(league: League, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CHECKS", (doctor._home, doctor._registry))
    home.mkdir()
    (home / "league.db").write_text("no database")
    document = league("doctor", "--json").json
    broken = [check for check in document["checks"] if check["status"] == "fail"]
    assert [check["what"] for check in broken] == ["registry"]
    assert "LEAGUE_HOME" in broken[0]["advice"]


def test_a_missing_optional_package_is_a_note(league: League, monkeypatch: pytest.MonkeyPatch) -> None:
    present = {name: version for name, version in doctor.VERIFIED.items() if name not in ("rlcard", "onnx")}
    monkeypatch.setattr(doctor, "installed", lambda: present)
    monkeypatch.setattr(doctor, "CHECKS", (doctor._stack,))
    statuses = {check["what"]: check["status"] for check in league("doctor", "--json").json["checks"]}
    assert statuses.pop("rlcard") == "note"
    assert statuses.pop("onnx") == "fail"
    assert set(statuses.values()) == {"ok"}


def test_the_ports_are_those_of_the_deployment(league: League, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CHECKS", (doctor._ports,))
    monkeypatch.setattr(launch, "DEPLOY_YAML", deploy := tmp_path / "deploy.yaml")
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_server(("127.0.0.1", 0)) as other:
        taken, free = (each.getsockname()[1] for each in (server, other))
        other.close()
        deploy.write_text(f"http_options: {{port: {free}}}\ngrpc_options: {{port: {taken}}}\n")
        http, grpc = league("doctor", "--json").json["checks"]
    assert (http["what"], http["status"], http["found"]) == ("serving HTTP", "ok", f"port {free} is free")
    assert (grpc["what"], grpc["status"], grpc["found"]) == ("serving gRPC", "note", f"port {taken} is in use")
    assert "--grpc-port PORT" in grpc["advice"]
