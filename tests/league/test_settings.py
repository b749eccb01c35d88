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


@pytest.mark.parametrize("name", ["a?b", "a%41", "a%", "a#b", "ä b"])
def test_the_database_is_inside_any_home(tmp_path: Path, name: str) -> None:
    home = tmp_path / name
    with closing(Registry.open(Storage.at(home))):
        assert (home / "league.db").is_file()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_exported_settings_are_read_back_from_any_directory(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("LEAGUE_HOME", "LEAGUE_DATABASE_URL", "LEAGUE_ARTIFACTS"):
        monkeypatch.setenv(name, "")  # monkeypatch restores them after export()
    storage = Storage.at(tmp_path / "home")
    storage.export()
    monkeypatch.chdir("/")
    assert Storage.from_environment() == storage


@pytest.mark.parametrize(
    ("url", "artifacts", "is_shared"),
    [
        ("sqlite:////home/league.db", "/mnt/artifacts", False),
        (SERVER, "/home/artifacts", False),
        (SERVER, "/mnt/artifacts", True),
    ],
)
def test_several_machines_need_a_database_server_and_a_mount(url: str, artifacts: str, is_shared: bool) -> None:
    storage = Storage(Path("/home"), url, Path(artifacts))
    storage.check_reach({"192.0.2.1"})
    if is_shared:
        storage.check_reach({"192.0.2.1", "192.0.2.2"})
        return
    with pytest.raises(ConfigError, match=r"2 machines: set LEAGUE_DATABASE_URL .* LEAGUE_ARTIFACTS"):
        storage.check_reach({"192.0.2.1", "192.0.2.2"})


@pytest.mark.parametrize(
    ("url", "has_password"),
    [
        ("sqlite:////home/league.db", False),
        ("postgresql://league@db/league", False),
        ("postgresql+psycopg://league:secret@db/league", True),
        ("postgresql://db/league?user=league&password=secret", True),
    ],
)
def test_a_password_in_the_url_is_noticed(url: str, has_password: bool) -> None:
    assert Storage(Path("/home"), url, Path("/artifacts")).has_password is has_password
