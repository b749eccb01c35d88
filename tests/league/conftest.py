from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import pytest

from league.settings import Storage
from tests.support.servers import postgresql


@pytest.fixture(params=["sqlite", "postgresql"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    """An empty home, for each database."""
    storage = Storage.at(tmp_path / "home")
    if request.param == "sqlite":
        return storage
    socket = request.getfixturevalue("postgresql_socket")
    return replace(storage, database_url=postgresql.create(socket, f"league_{uuid4().hex}"))
