"""Which version a run or a night's training starts from."""

from pathlib import Path
from typing import Any

import pytest

from league.config.league import LeagueConfig
from league.errors import ConfigError, InterfaceChanged
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, Manifest
from tests.support.leagues import registries
from tests.support.leagues.registries import LEAGUE
from training.runs.parent import check_network, parent_version, start_version


def publish(registry: Registry, **manifest: Any) -> CheckpointRef:
    build = registries.builder()

    def build_other(directory: Path, number: int) -> Manifest:
        return build(directory, number).model_copy(update=manifest)

    source = f"run/{len(registry.versions.all(LEAGUE))}"
    return CheckpointRef(LEAGUE, registry.publisher.publish(LEAGUE, build_other, source=source, parent=None).number)


def test_a_version_that_was_trained_continues(registry: Registry) -> None:
    first = publish(registry)
    publish(registry)
    assert start_version(registry, first, registries.config(), None) == first


def test_a_search_version_continues_with_what_it_plays(registry: Registry) -> None:
    first = publish(registry)
    publish(registry)
    search = registry.publisher.publish_search(LEAGUE, 1, "puct", 8, 1.0)
    assert start_version(registry, CheckpointRef(LEAGUE, search.number), registries.config(), None) == first


def test_in_place_of_an_imported_version_the_newest_one_continues(registry: Registry) -> None:
    imported = publish(registry, algorithm="imported")
    assert start_version(registry, imported, registries.config(), None) is None
    trained = publish(registry)
    publish(registry, role=EXPLOITER, exploits=str(imported))
    publish(registry, algorithm="imported")
    assert start_version(registry, imported, registries.config(), None) == trained


def test_mixtures_search_versions_and_other_leagues_or_spaces_are_refused(registry: Registry) -> None:
    config, interface = registries.config(), registry.leagues.get(LEAGUE).interface
    first, second = publish(registry), publish(registry)
    assert parent_version(registry, first, config, interface).number == 1
    registry.publisher.publish_mixture(LEAGUE, {1: 0.25, 2: 0.75})
    registry.publisher.publish_search(LEAGUE, 1, "puct", 8, 1.0)
    for ref, error, message in (
        (CheckpointRef("chess", 1), ConfigError, "chess@1 belongs to another league than tictactoe"),
        (CheckpointRef(LEAGUE, 3), ConfigError, r"tictactoe@3 is a mixture .*: start from one of its members"),
        (CheckpointRef(LEAGUE, 4), ConfigError, r"tictactoe@4 searches .*: start from @1"),
    ):
        with pytest.raises(error, match=f"^--from: {message}"):
            parent_version(registry, ref, config, interface)
    fewer = interface.model_copy(update={"agents": {}})
    with pytest.raises(InterfaceChanged, match="tictactoe@2 has other spaces or policies than the environment now"):
        parent_version(registry, second, config, fewer)


def with_algorithm(algorithm: str) -> LeagueConfig:
    return LeagueConfig.from_mapping(registries.config().model_dump() | {"training": {"algorithm": algorithm}})


def test_a_version_continues_with_its_own_network_only(registry: Registry, subtests: pytest.Subtests) -> None:
    """Settings that did not exist when the version was trained have their defaults."""
    for algorithm, changed, value in (
        ("ppo", "hidden", [32]),
        ("ppo", "recurrence", {"width": 4}),
        ("maddpg", "critic", "own"),
        ("qmix", "mixer", "vdn"),
        ("dqn", "dueling", False),
    ):
        with subtests.test(changed):
            version = registry.versions.resolve(
                publish(registry, algorithm=algorithm, settings={"algorithm": algorithm})
            )
            config = with_algorithm(algorithm)
            check_network(version, config)
            check_network(version, config.with_training(lr=0.5, gamma=0.5))
            with pytest.raises(ConfigError, match=rf"^training\.{changed}: tictactoe@\d was trained with .*, got "):
                check_network(version, config.with_training(**{changed: value}))


def test_an_algorithm_continues_what_one_that_it_is_derived_from_has_trained(registry: Registry) -> None:
    settings = {"algorithm": "marwil", "data": "games"}
    version = registry.versions.resolve(publish(registry, algorithm="marwil", settings=settings))
    check_network(version, registries.config())
    with pytest.raises(ConfigError, match=r"^training\.algorithm: tictactoe@1 was trained with marwil, got dqn$"):
        check_network(version, with_algorithm("dqn"))
