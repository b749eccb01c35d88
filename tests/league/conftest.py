from pathlib import Path

import pytest

from league.settings import Storage
from tests.support.databases import StorageAt


@pytest.fixture
def storage(storage_at: StorageAt, tmp_path: Path) -> Storage:
    """An empty home; for each database in modules that are marked `on_both_databases`."""
    return storage_at(tmp_path / "home")
