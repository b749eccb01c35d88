from pathlib import Path

import pytest

from cli import doctor
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
