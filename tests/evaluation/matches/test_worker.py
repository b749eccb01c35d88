from pathlib import Path

from evaluation.matches.worker import MOST_WORKERS, match_worker
from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import config, registered


def open_files(home: Path) -> int:
    files = (file.resolve() for file in Path("/proc/self/fd").iterdir() if file.exists())
    return sum(file.is_relative_to(home) for file in files)


def test_the_workers_of_a_few_leagues_are_kept(tmp_path: Path) -> None:
    document = config().model_dump_json(by_alias=True)
    storages = [Storage.at(tmp_path / str(number)) for number in range(MOST_WORKERS + 1)]
    for storage in storages:
        registered(Registry.open(storage)).close()
    workers = [match_worker(storage, document) for storage in storages[:-1]]
    workers[0]._registry.leagues.get("tictactoe")
    workers[1]._registry.leagues.get("tictactoe")
    assert match_worker(storages[0], document) is workers[0]
    match_worker(storages[-1], document)
    assert match_worker(storages[0], document) is workers[0]
    assert open_files(tmp_path / "0") > 0
    assert open_files(tmp_path / "1") == 0, "the worker that was not used for longest is closed"
