from pathlib import Path

import pytest
import ray

from league.errors import ConfigError
from league.settings import Storage
from training.cluster import connected

SHARED = Storage(Path("/home/x"), "postgresql://db/league", Path("/mnt/artifacts"))


def nodes(*addresses: str, alive: bool = True) -> list[dict[str, object]]:
    return [{"NodeManagerAddress": address, "Alive": alive} for address in addresses]


@pytest.mark.usefixtures("ray_session")
def test_several_machines_need_storage_that_all_of_them_reach(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "nodes", lambda: nodes("192.0.2.1", "192.0.2.2"))
    with (
        pytest.raises(ConfigError, match=r"2 machines: set LEAGUE_DATABASE_URL .* LEAGUE_ARTIFACTS"),
        connected(None, Storage.at(tmp_path)),
    ):
        pass
    with connected(None, SHARED):
        pass


@pytest.mark.usefixtures("ray_session")
def test_machines_that_are_gone_do_not_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = nodes("192.0.2.1") + nodes("192.0.2.2", alive=False)
    monkeypatch.setattr(ray, "nodes", lambda: found)
    with connected(None, Storage.at(tmp_path)):
        pass


@pytest.mark.usefixtures("ray_session")
def test_the_callers_ray_is_left_running(tmp_path: Path) -> None:
    with connected(None, Storage.at(tmp_path)):
        pass
    assert ray.is_initialized()
