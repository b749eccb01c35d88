from contextlib import closing
from pathlib import Path

import pytest

from league.errors import ConfigError
from league.registry.registry import Registry
from league.settings import Storage

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
