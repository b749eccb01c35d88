"""A version acts identically in training, in evaluation and over HTTP: a short form of `benchmarks.parity`."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.parity import CONFIGS, compare, prepare
from league.config.league import LeagueConfig
from league.config.off_policy import OffPolicyConfig
from league.registry.registry import Registry
from league.registry.storage.rows import VersionRow
from league.settings import Storage
from serve_app.runtime.launch import running

pytestmark = pytest.mark.slow

OBSERVATIONS = 300
PATHS = sorted(CONFIGS.glob("*.yaml"))
SMALL = {"train_batch_size": 64, "minibatch_size": 32, "epochs": 1}
SMALL_REPLAY = {"learning_starts": 64, "batch_size": 32}

Served = tuple[Registry, str, dict[str, VersionRow]]


@pytest.fixture(scope="module")
def served(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """All shipped configurations, trained for one update and promoted on one server."""
    registry = Registry.open(Storage.at(tmp_path_factory.mktemp("parity")))
    versions = {path.stem: prepare(path, registry, updates=1, num_envs=2, **small_settings(path)) for path in PATHS}
    with running(registry.storage, replicas=1) as url:
        yield registry, url, versions
    registry.close()


def small_settings(path: Path) -> dict[str, int]:
    """Settings of a short update."""
    return SMALL_REPLAY if isinstance(LeagueConfig.load(path).training, OffPolicyConfig) else SMALL


@pytest.mark.parametrize("name", [path.stem for path in PATHS])
def test_module_graph_and_endpoint_act_identically(name: str, served: Served) -> None:
    registry, url, versions = served
    compared = compare(versions[name], registry, url, OBSERVATIONS)
    assert {parity.policy for parity in compared} == set(versions[name].manifest.policies)
    for parity in compared:
        assert parity.observations == OBSERVATIONS
        assert parity.equal, parity
