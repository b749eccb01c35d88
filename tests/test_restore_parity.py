"""What a version does in training, in evaluation and over HTTP is the same; `benchmarks.parity`, in short."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.parity import CONFIGS, compare, prepare
from league.config import LeagueConfig
from league.registry.registry import Registry
from league.registry.rows import VersionRow
from league.settings import Storage
from league.training_config import OffPolicyConfig
from serve_app.launch import running

OBSERVATIONS = 300
PATHS = sorted(CONFIGS.glob("*.yaml"))
SMALL = {"train_batch_size": 64, "minibatch_size": 32, "epochs": 1}
SMALL_REPLAY = {"learning_starts": 64, "batch_size": 32}

Served = tuple[Registry, str, dict[str, VersionRow]]


@pytest.fixture(scope="module")
def served(ray_session: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Every shipped configuration, trained for an update and promoted on one server."""
    registry = Registry.open(Storage.at(tmp_path_factory.mktemp("parity")))
    versions = {path.stem: prepare(path, registry, updates=1, copies=2, **small(path)) for path in PATHS}
    with running(registry.storage, replicas=1) as url:
        yield registry, url, versions
    registry.close()


def small(path: Path) -> dict[str, int]:
    """Settings of an update that is over soon."""
    return SMALL_REPLAY if isinstance(LeagueConfig.load(path).training, OffPolicyConfig) else SMALL


@pytest.mark.parametrize("name", [path.stem for path in PATHS])
def test_module_graph_and_endpoint_act_alike(name: str, served: Served) -> None:
    registry, url, versions = served
    compared = compare(versions[name], registry, url, OBSERVATIONS)
    assert {each.policy for each in compared} == set(versions[name].manifest.policies)
    for each in compared:
        assert each.observations == OBSERVATIONS
        assert each.equal, each
