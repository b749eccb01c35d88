"""Fixtures and settings shared by the tests of several packages."""

import gc
import os
import re
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

pytest_plugins = ("tests.support.distribution",)
ONLY_SLOW = re.compile(r"^pytestmark = .*pytest\.mark\.slow\b", re.MULTILINE)
WORDS = {"slow": r"slow|on_both_databases", "e2e": "e2e"}
"""What a file with such tests contains."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file without slow tests in `make test-slow`, none with slow tests only in `make test`, and none without
    a test of `make test-e2e` there. Every process imports all others: half of the time of a collection.
    """
    if not collection_path.match("test_*.py"):
        return None
    text = collection_path.read_text()
    if config.option.markexpr == "not slow and not e2e":
        return bool(ONLY_SLOW.search(text)) or None
    return not re.search(WORDS.get(config.option.markexpr, ""), text) or None


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
    for connection_pool in opened:
        connection_pool.close()


@pytest.fixture(autouse=True, scope="session")
def unsynced() -> Iterator[None]:
    """Do not wait for the disk at each of thousands of transactions."""
    with without_syncing():
        yield


@pytest.fixture
def short_examinations(monkeypatch: pytest.MonkeyPatch) -> None:
    """`check-env` compares 20,000 steps with the stock environment, and measures the speed for a second."""
    monkeypatch.setattr("league.environments.conformance.examination.COMPARED_STEPS", 500)
    monkeypatch.setattr("league.environments.conformance.examination.MEASURED_SECONDS", 0.01)


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
