import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.cluster import league_cluster
from tests.support.cluster.league_cluster import LeagueCluster


@pytest.fixture(scope="module")
def directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all machines share."""
    folder = tmp_path_factory.mktemp("cluster")
    for path in (folder, folder.parent):
        path.chmod(0o755)  # PostgreSQL runs as another user
    return folder


@pytest.fixture(scope="module")
def cluster(directory: Path) -> Iterator[LeagueCluster]:
    """A cluster of three nodes in network namespaces."""
    if (reason := league_cluster.obstacle()) is not None:
        if os.environ.get("CI") and os.geteuid() == 0:
            pytest.fail(reason)
        pytest.skip(reason)
    with league_cluster.cluster(directory) as running:
        yield running
