"""Fixtures and settings shared by the tests of several packages."""

import gc
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from hypothesis import HealthCheck, settings

from league.registry.storage import database
from league.registry.storage.database import Database
from league.settings import Storage
from tests.support.databases import StorageAt
from tests.support.durability import without_syncing
from tests.support.schema import migrated_once
from tests.support.servers import postgresql

# Tests do not measure time: other load on the machine must not make one fail. All draw the same examples, so that a
# change fails where it is made; others are drawn every night.
settings.register_profile(
    "same",
    deadline=None,
    derandomize=True,
    suppress_health_check=[
        HealthCheck.too_slow,
        HealthCheck.data_too_large,
        HealthCheck.large_base_example,
        HealthCheck.function_scoped_fixture,
    ],
)
settings.register_profile("random", settings.get_profile("same"), derandomize=False, print_blob=True)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))
# By default Ray's workers have niceness 15: next to four busy processes they get a fiftieth of a core, and a training
# run that takes half a minute was not ready after ten.
os.environ.setdefault("RAY_worker_niceness", "0")

ROOT = Path(__file__).parents[1]
SHARED = ("ray_session", "ray_server")
"""Session fixtures that take long to set up."""
SECONDS = {
    "tests/cluster/test_autoscaler.py": 60,
    "tests/serve_app/test_autoscaling.py": 39,
    "tests/evaluation/gating/test_training_night.py": 60,
    "tests/evaluation/gating/test_nightly.py": 30,
    "tests/training/runs/test_train.py": 26,
    "tests/test_tutorial.py": 25,
    "tests/benchmarks/": 20,
    "tests/serve_app/test_attacks.py": 30,
    "tests/test_wheel.py": 15,
    "tests/league/local_ray/": 10,
    "tests/training/test_learning.py": 10,
    "tests/training/algorithms/": 8,
    "tests/serve_app/test_faults.py": 7,
    "tests/test_restore_parity.py": 6,
    "tests/browser/": 3,
    "tests/test_environments.py": 3,
}
"""Processor time of a slow test of these files and folders, about; of any other test, a second. Wrong values cost time
only: long files that start last leave a process without work."""


ONLY_SLOW = re.compile(r"^pytestmark = .*pytest\.mark\.slow\b", re.MULTILINE)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Distribute files among the processes. Files that share a server, and files of a folder that share a Ray session,
    go to the same process. A process starts one Ray, whichever of them it runs; all files of `tests/training` together
    would be the longest part of the slow tests."""
    from xdist.scheduler import LoadScopeScheduling

    if gone := [path for path in SECONDS if not (ROOT / path).exists()]:
        raise pytest.UsageError(f"tests/conftest.py: SECONDS names {gone[0]}, which does not exist")

    class BySharedResource(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _shared_resource(nodeid.partition("::")[0])

    config.option.loadscopereorder = False  # by the number of tests
    return BySharedResource(config, log)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Of the files without slow tests, `make test-slow` imports none, and `make test` none with slow tests only. Every
    process imports all others: half of the time of a collection.
    """
    if not collection_path.match("test_*.py"):
        return None
    text = collection_path.read_text()
    if config.option.markexpr == "slow":
        return not re.search(r"slow|on_both_databases", text) or None
    return (config.option.markexpr == "not slow" and bool(ONLY_SLOW.search(text))) or None


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let each of several processes start with the files that take longest."""
    if hasattr(config, "workerinput"):
        seconds = Counter[str]()
        files = {item: item.nodeid.partition("::")[0] for item in items}
        for file in files.values():
            seconds[_shared_resource(file)] += next((SECONDS[path] for path in SECONDS if file.startswith(path)), 1)
        items.sort(key=lambda item: -seconds[_shared_resource(files[item])])


@cache
def _shared_resource(file: str) -> str:
    text = (ROOT / file).read_text()
    shared = next((fixture for fixture in SHARED if fixture in text), file)
    if shared == "ray_session":
        return f"{shared} of {Path(file).parent}"
    return "browser" if file.startswith("tests/browser/") else shared


def pytest_collection_finish() -> None:
    """Collect garbage rarely, and not among the modules and tests that exist now: it took 8 % of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run tests that are marked for it with each database; with PostgreSQL, `make test` runs those of the registry."""
    if "storage_at" in metafunc.fixturenames and metafunc.definition.get_closest_marker("both_databases"):
        of_registry = metafunc.module.__name__.startswith("tests.league.")
        other = pytest.param("postgresql", marks=() if of_registry else pytest.mark.slow)
        metafunc.parametrize("storage_at", ["sqlite", other], indirect=True)


@pytest.fixture(autouse=True, scope="session")
def schema() -> Iterator[None]:
    """Run migrations, the slowest part of many tests, once in a process."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(database, "_apply", migrated_once(database._apply))
        yield


@pytest.fixture(autouse=True, scope="module")
def closed_databases() -> Iterator[None]:
    """Close the connections that a test file leaves to the garbage collector, which seldom runs."""
    opened: list[Database] = []
    connect = Database.__init__

    def record(self: Database, *arguments: Any, **options: Any) -> None:
        connect(self, *arguments, **options)
        opened.append(self)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Database, "__init__", record)
        yield
    for each in opened:
        each.close()


@pytest.fixture(autouse=True, scope="session")
def unsynced() -> Iterator[None]:
    """Do not wait for the disk at each of thousands of transactions."""
    with without_syncing():
        yield


@pytest.fixture(scope="session")
def parsed_operators() -> Iterator[None]:
    """Torch's ONNX exporter parses its 500 operators at each export, which takes half of its time."""
    from torch.onnx._internal.exporter._registration import ONNXRegistry

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ONNXRegistry, "from_torchlib", staticmethod(cache(ONNXRegistry.from_torchlib)))
        yield


@pytest.fixture(scope="session")
def ray_session() -> Iterator[None]:
    """One Ray with two CPUs for all tests of this process that need it."""
    from league import ray_cluster

    with ray_cluster.ray_session():
        ray_cluster.start_local(ray_cluster.LocalRay(cpus=2, runtime_envs=True))
        yield


@pytest.fixture(scope="session")
def postgresql_socket() -> Iterator[Path]:
    """The socket of a PostgreSQL server; the test is skipped if its programs are not installed, and fails in CI."""
    programs = postgresql.programs()
    if programs is None:
        missing = (
            "the programs of a PostgreSQL server are not installed: `apt-get install postgresql` enables this test"
        )
        (pytest.fail if os.environ.get("CI") else pytest.skip)(missing)
    with postgresql.server(programs) as socket:
        yield socket


@pytest.fixture
def storage_at(request: pytest.FixtureRequest) -> StorageAt:
    """Returns the storage of an empty home: with SQLite, unless the test is marked `on_both_databases`."""
    if getattr(request, "param", "sqlite") == "sqlite":
        return Storage.at
    socket = request.getfixturevalue("postgresql_socket")
    return lambda home: replace(Storage.at(home), database_url=postgresql.create(socket, f"league_{uuid4().hex}"))
