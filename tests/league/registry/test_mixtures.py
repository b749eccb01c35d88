"""Mixtures are published as versions, so that an alias, its history and a rollback treat one as a whole."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import update

from league.errors import EnvironmentMismatch, InvalidInput, NotPromotable, UnknownVersion, VersionRetired
from league.registry.registry import Registry
from league.registry.storage.manifest import EXPLOITER, MIXTURE, TRAINING, Manifest
from league.registry.storage.tables import VersionTable
from league.results.ledger import Ledger
from tests.support.leagues.ledger_matches import SCHEDULE
from tests.support.leagues.registries import LEAGUE, builder, config, promote, publish, registered


def test_a_mixture_is_a_version(registry: Registry) -> None:
    registered(registry, versions=3)
    row = registry.publisher.publish_mixture(LEAGUE, {3: 0.4, 1: 0.6})
    assert (row.number, row.role, row.steps) == (4, MIXTURE, 3000)
    assert row.mixture is not None
    assert [(member.version, member.probability) for member in row.mixture.members] == [(1, 0.6), (3, 0.4)]
    digests = [registry.versions.get(LEAGUE, number).sha256 for number in (1, 3)]
    assert [member.sha256 for member in row.mixture.members] == digests
    assert registry.artifacts.verify_names(LEAGUE, 4, row.sha256).mixture == row.mixture
    assert registry.publisher.publish_mixture(LEAGUE, {1: 0.6, 3: 0.4}) == row, "equal mixtures are one version"
    assert registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 3: 0.5}).number == 5


def test_unsuitable_members_are_rejected(registry: Registry, subtests: pytest.Subtests) -> None:
    registered(registry, versions=2)
    registry.publisher.publish(LEAGUE, exploiter, source="exploiter")
    registry.publisher.publish_mixture(LEAGUE, {1: 0.6, 2: 0.4})
    registry.publisher.publish(LEAGUE, elsewhere, source="elsewhere")
    for shares, error, message in (
        ({1: 0.5, 9: 0.5}, UnknownVersion, "has no version 9; the newest is 5"),
        ({1: 0.5, 2: 0.4}, InvalidInput, "sum to 0.9, expected 1"),
        ({1: 0.5, 4: 0.5}, InvalidInput, r"tictactoe@4 is a mixture \(@1 60.0 %, @2 40.0 %\): name one"),
        ({1: 0.5, 3: 0.5}, NotPromotable, "tictactoe@3 has the role exploiter"),
        ({1: 0.5, 5: 0.5}, EnvironmentMismatch, "tictactoe@1 and tictactoe@5 were trained in different environments"),
    ):
        with subtests.test(shares=shares), pytest.raises(error, match=message):
            registry.publisher.publish_mixture(LEAGUE, shares)
    assert [row.number for row in registry.versions.all(LEAGUE)] == [1, 2, 3, 4, 5], "nothing was published"


def test_members_of_another_interface_are_rejected(registry: Registry, tmp_path: Path) -> None:
    registered(registry, versions=2)
    files = registry.versions.get(LEAGUE, 2).manifest.files
    manifest = builder(squares=4)(tmp_path, 2).model_copy(update={"files": files})
    with registry.database.write() as session:
        session.execute(update(VersionTable).filter_by(number=2).values(manifest=manifest.to_json()))
    with pytest.raises(EnvironmentMismatch, match="tictactoe@2 has other spaces or policies than league tictactoe"):
        registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 2: 0.5})


def test_what_needs_a_mixture_needs_its_members(registry: Registry) -> None:
    registered(registry, versions=6)
    for shares in ({1: 0.5, 2: 0.5}, {3: 0.5, 4: 0.5}, {5: 0.5, 6: 0.5}):
        registry.publisher.publish_mixture(LEAGUE, shares)
    publish(registry, "newest")
    with registry.database.write() as session:
        session.execute(update(VersionTable).values(reserved_at=datetime.now(UTC) - timedelta(days=365)))
    promote(registry, 7)
    Ledger(registry).open(replace(SCHEDULE, league=LEAGUE, contestants=(f"{LEAGUE}@8", "script:random")))
    removal = registry.retention.retire(LEAGUE, keep=1, before=datetime.now(UTC) - timedelta(days=30))
    assert set(removal.versions) == {5, 6}, "neither mixtures nor members that somebody needs"
    assert set(removal.training) == {3, 4}, "the members of the champion keep their training state"
    assert (registry.artifacts.path(LEAGUE, 1) / TRAINING).exists()
    with pytest.raises(VersionRetired, match="tictactoe@5 was retired"):
        promote(registry, 9)
    with pytest.raises(VersionRetired, match="tictactoe@6 was retired and its files were removed: it cannot play"):
        registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 6: 0.5})


def exploiter(directory: Path, number: int) -> Manifest:
    return builder()(directory, number).model_copy(update={"role": EXPLOITER, "exploits": f"{LEAGUE}@1"})


def elsewhere(directory: Path, number: int) -> Manifest:
    environment = config(kwargs={"render_mode": None}).environment
    return builder()(directory, number).model_copy(
        update={"environment": environment, "environment_digest": environment.digest()}
    )
