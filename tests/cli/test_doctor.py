from pathlib import Path

from tests.cli.conftest import League


def test_the_doctor_looks_at_everything_and_finds_this_machine_fit(league: League) -> None:
    outcome = league("doctor", "--json")
    document = outcome.json
    found = {check["what"]: check["status"] for check in document["checks"]}
    assert {"Python", "ray", "torch", "CPU", "GPU", "LEAGUE_HOME", "disk", "registry", "Ray", "HAProxy"} <= set(found)
    assert document["ok"], document
    assert outcome.code == 0


def test_the_doctor_says_what_to_do_about_a_broken_home(league: League, home: Path) -> None:
    home.mkdir()
    (home / "league.db").write_text("no database")
    document = league("doctor", "--json").json
    broken = [check for check in document["checks"] if check["status"] == "fail"]
    assert [check["what"] for check in broken] == ["registry"]
    assert "LEAGUE_HOME" in broken[0]["advice"]
