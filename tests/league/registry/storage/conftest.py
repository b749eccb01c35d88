from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from uuid import uuid4

import pytest

from league.registry.registry import Registry
from league.settings import Storage
from tests.support.leagues.registries import registered
from tests.support.servers import object_store, postgresql


@pytest.fixture
def postgresql_storage(tmp_path: Path, postgresql_socket: Path) -> Storage:
    url = postgresql.create(postgresql_socket, f"league_{uuid4().hex}")
    return replace(Storage.at(tmp_path / "home"), database_url=url)


@dataclass(frozen=True)
class Store:
    """A registry with one league, and access to the files behind its artefact store. Names: `tictactoe/1/…`."""

    registry: Registry
    replace: Callable[[str, bytes], object]
    remove: Callable[[str], object]
    names: Callable[[], list[str]]


@pytest.fixture(scope="session")
def s3_endpoint() -> Iterator[str]:
    with object_store.server() as endpoint:
        yield endpoint


@pytest.fixture
def bucket(s3_endpoint: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The URL of an empty bucket; the environment has its credentials."""
    for name, value in object_store.variables(s3_endpoint).items():
        monkeypatch.setenv(name, value)
    return object_store.create_bucket(s3_endpoint)


@pytest.fixture(params=["directory", "object store"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Store]:
    storage = Storage.at(tmp_path / "home")
    if request.param == "directory":
        root = tmp_path / "home" / "artifacts"
        registry = Registry.open(storage)
        yield Store(
            registered(registry),
            lambda name, content: (root / name).write_bytes(content),
            lambda name: (root / name).unlink(),
            lambda: sorted(p.relative_to(root).as_posix() for p in root.rglob("*") if p.is_file()),
        )
    else:
        url = request.getfixturevalue("bucket")
        registry = Registry.open(Storage(storage.home, storage.database_url, url))
        yield Store(
            registered(registry),
            lambda name, content: object_store.put(url, name, content),
            lambda name: object_store.delete(url, name),
            lambda: object_store.keys(url),
        )
    registry.close()
