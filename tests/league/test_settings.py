import tomllib
from contextlib import closing
from pathlib import Path

import pytest

import policy_league_client
from league import client
from league.client import pettingzoo
from league.errors import ConfigError
from league.registry.registry import Registry
from league.settings import Storage
from league.stack import VERIFIED, installed
from policy_league_client.pettingzoo import play

SERVER = "postgresql://db/league"


def test_defaults_are_inside_the_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("LEAGUE_HOME", "LEAGUE_DATABASE_URL", "LEAGUE_ARTIFACTS"):
        monkeypatch.delenv(name, raising=False)
    home = tmp_path / "league-home"
    assert Storage.from_environment() == Storage(home, f"sqlite:///{home}/league.db", home / "artifacts")
    monkeypatch.setenv("LEAGUE_HOME", "elsewhere")
    monkeypatch.setenv("LEAGUE_DATABASE_URL", SERVER)
    monkeypatch.setenv("LEAGUE_ARTIFACTS", "shelf")
    assert Storage.from_environment() == Storage(tmp_path / "elsewhere", SERVER, tmp_path / "shelf")


def test_exported_settings_are_read_back_from_any_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("LEAGUE_HOME", "LEAGUE_DATABASE_URL", "LEAGUE_ARTIFACTS"):
        monkeypatch.setenv(name, "")  # monkeypatch restores them after export()
    storage = Storage.at(tmp_path / "home")
    storage.export()
    monkeypatch.chdir("/")
    assert Storage.from_environment() == storage


def test_the_database_is_inside_any_home(tmp_path: Path) -> None:
    names = ["a?b", "a%41", "a%", "a#b", "ä b", "50%", "#1"]
    for name in names:
        with closing(Registry.open(Storage.at(tmp_path / name))):
            assert (tmp_path / name / "league.db").is_file()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(names)


def test_several_machines_need_a_database_server_and_a_mount() -> None:
    for url, artifacts in (("sqlite:////home/league.db", "/mnt/artifacts"), (SERVER, "/home/artifacts")):
        storage = Storage(Path("/home"), url, Path(artifacts))
        storage.check_reach({"192.0.2.1"})
        with pytest.raises(ConfigError, match=r"2 machines: set LEAGUE_DATABASE_URL .* LEAGUE_ARTIFACTS"):
            storage.check_reach({"192.0.2.1", "192.0.2.2"})
    Storage(Path("/home"), SERVER, Path("/mnt/artifacts")).check_reach({"192.0.2.1", "192.0.2.2"})


def test_a_password_in_the_url_is_noticed() -> None:
    for url, has_password in (
        ("sqlite:////home/league.db", False),
        ("postgresql://league@db/league", False),
        ("postgresql+psycopg://league:secret@db/league", True),
        ("postgresql://db/league?user=league&password=secret", True),
    ):
        assert Storage(Path("/home"), url, Path("/artifacts")).has_password is has_password


def test_the_verified_stack_equals_the_constraints() -> None:
    lines = Path("constraints.txt").read_text().splitlines()
    pins = dict(line.lower().split("==") for line in lines if "==" in line)
    assert {package: pins.get(package) for package in VERIFIED} == VERIFIED


def test_build_dependencies_are_pinned() -> None:
    """pip installs them in an environment of its own, without the constraints."""
    required = tomllib.loads(Path("pyproject.toml").read_text())["build-system"]["requires"]
    assert set(required) <= set(Path("constraints.txt").read_text().splitlines())


def test_the_tests_run_on_the_verified_stack() -> None:
    assert {name: version.partition("+")[0] for name, version in installed().items()} == VERIFIED


def test_the_client_is_available_under_both_names() -> None:
    assert [getattr(client, name) for name in policy_league_client.__all__] == [
        getattr(policy_league_client, name) for name in policy_league_client.__all__
    ]
    assert pettingzoo.play is play


def test_an_unknown_name_of_the_client_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'policy_league_client' has no attribute 'Klient'"):
        policy_league_client.Klient  # noqa: B018
