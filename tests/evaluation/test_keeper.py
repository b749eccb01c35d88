"""The keeper: whatever changes, snapshots follow; with one process at a time, which dies with its studio."""

import logging
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from evaluation import keeper
from evaluation.keeper import Keeper
from evaluation.studio import Studio
from evaluation.tournament import evaluate
from league.environments.building import interface
from league.registry.registry import Registry
from tests.evaluation import examples
from tests.evaluation.examples import LEAGUE
from tests.evaluation.waiting import until


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    opened = examples.registry(tmp_path / "home")
    for name, value in (
        ("LEAGUE_HOME", opened.storage.home),
        ("LEAGUE_DATABASE_URL", opened.storage.database_url),
        ("LEAGUE_ARTIFACTS", opened.storage.artifacts),
    ):
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(keeper, "LOOK", 0.01)
    monkeypatch.setattr(keeper, "REST", 0)
    yield opened
    opened.close()


@contextmanager
def at_work(registry: Registry) -> Iterator[Keeper]:
    working = Keeper(registry)
    working.start()
    try:
        yield working
    finally:
        working.close()


def another_league(registry: Registry, name: str) -> None:
    config = examples.config(league=name)
    registry.register(config, interface(config))


def play(registry: Registry, seed: int) -> int:
    """Returns how many games were played."""
    return evaluate(LEAGUE, ["script:random", "script:first"], registry=registry, blocks=2, seed=seed).games


def games(registry: Registry) -> int:
    row = registry.snapshot(LEAGUE, "summary")
    return row.document["games"] if row else 0


def test_snapshots_follow_the_ledger(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR), at_work(registry) as working:
        until(lambda: registry.snapshot(LEAGUE, "summary") is not None)
        first = play(registry, seed=1)
        until(lambda: games(registry) == first)
        second = play(registry, seed=2)
        until(lambda: games(registry) == first + second)
        assert working.is_watching
    assert not working.is_watching
    assert "failed" not in caplog.text, "a process that has done its work ends well"


def test_two_of_them_do_no_harm(registry: Registry) -> None:
    another_league(registry, "chess")
    with at_work(registry), at_work(registry):
        played = play(registry, seed=1)
        until(lambda: registry.stale_snapshots() == [])
    assert games(registry) == played


def test_a_league_whose_process_fails_is_let_rest_and_the_others_have_their_turn(
    registry: Registry, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    another_league(registry, "chess")
    monkeypatch.setattr(sys, "executable", "/bin/false")
    looks = []
    stale = registry.stale_snapshots
    monkeypatch.setattr(registry, "stale_snapshots", lambda: looks.append(1) or stale())
    with caplog.at_level(logging.ERROR), at_work(registry):
        until(lambda: len(looks) > 6)
    failed = [record.args[0] for record in caplog.records if "failed" in record.message and record.args]
    assert sorted(failed) == ["chess", LEAGUE]


def test_it_goes_on_when_the_database_is_back(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    database = registry.storage.home / "league.db"
    with caplog.at_level(logging.ERROR), at_work(registry):
        until(lambda: registry.stale_snapshots() == [])
        away = database.rename(database.with_name("away.db"))
        until(lambda: "snapshots cannot be kept" in caplog.text)
        away.rename(database)
        played = play(registry, seed=1)
        until(lambda: games(registry) == played)


@pytest.mark.usefixtures("ray_session")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_studio_has_one(registry: Registry, monkeypatch: pytest.MonkeyPatch) -> None:
    studio = Studio(workers=1, at_once=1)
    play(registry, seed=1)
    until(lambda: registry.stale_snapshots() == [])
    studio.check_health()

    def has_a_bug(_: Registry) -> list[str]:
        raise ZeroDivisionError

    monkeypatch.setattr(Registry, "stale_snapshots", has_a_bug)
    until(lambda: is_ill(studio))


def is_ill(studio: Studio) -> bool:
    try:
        studio.check_health()
    except RuntimeError:
        return True
    return False


STUDIO = """
import sys
from evaluation import keeper
from league.registry.registry import Registry
keeper.LOOK, keeper.REST = 0.01, 0
keeper.Keeper(Registry.open()).start()
sys.stdin.read()
"""


def test_a_process_ends_with_its_studio_and_the_next_one_begins_again(registry: Registry) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", STUDIO], cwd=Path(__file__).parents[2], stdin=subprocess.PIPE
    ) as studio:
        until(lambda: len(at_work_below(studio.pid)) == 1)
        (process,) = at_work_below(studio.pid)
        studio.kill()
    until(lambda: not Path(f"/proc/{process}").exists())
    with at_work(registry):
        until(lambda: registry.stale_snapshots() == [])


def at_work_below(parent: int) -> list[int]:
    """The ids of a process's children that compute snapshots."""
    children = Path(f"/proc/{parent}/task").glob("*/children")
    found = [int(child) for path in children for child in path.read_text().split()]
    with suppress(FileNotFoundError):
        return [child for child in found if b"evaluation.snapshots" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return []
