"""Removal of versions and leagues, with what depends on them, and after a crash at any point."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest
from sqlalchemy import func, select, text

from league.errors import Conflict, LeagueArchived, NothingToRollBack
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import Portion, RunPoint, StrengthRow
from league.registry.storage.tables import Base
from league.results.ledger import Ledger
from league.settings import Storage
from tests.support.crashes import ProcessDeath, crash_after
from tests.support.leagues.ledger_matches import SCHEDULE, play_match
from tests.support.leagues.registries import LEAGUE, leftovers, publish, registered, verified
from tests.support.templates import copy_of

OTHER = "another"


VERDICT = f"{LEAGUE}-verdict-0f3a62d1c8b45e97-1b2c3d4e"


ANCHOR = f"{LEAGUE}-anchor-77c01d2e"


SETTINGS: dict[str, Any] = {"gate": {"alpha": 0.05}, "tests": [{"kind": "anchor", "schedule": ANCHOR}]}


@pytest.fixture
def used(storage: Storage) -> Iterator[Registry]:
    registry = copy_of(used_league, storage)
    yield registry
    registry.close()


def used_league(storage: Storage) -> Registry:
    """Versions 1, 2 (from 1), 3; 1 and 3 were champion; a verdict on 3 against 2 with the anchor 1; a second league."""
    registry = registered(Registry.open(storage))
    publish(registry, "run/1")
    publish(registry, "run/2", parent=1)
    publish(registry, "run/3")
    registered(registry, OTHER, versions=1)
    ledger = Ledger(registry)
    for name, opponent in ((VERDICT, 2), (ANCHOR, 1)):
        schedule = replace(SCHEDULE, id=name, league=LEAGUE, contestants=(f"{LEAGUE}@3", f"{LEAGUE}@{opponent}"))
        ledger.open(schedule)
        ledger.extend([play_match(schedule, 0)])
    registry.verdicts.open(LEAGUE, 3, f"{LEAGUE}@2", VERDICT, SETTINGS)
    move(registry, 1, None, None)
    move(registry, 3, 1, VERDICT)
    move(registry, 2, 3, None)
    registry.verdicts.close(VERDICT, "promote", {"promoted": True})
    registry.versions.set_note(CheckpointRef(LEAGUE, 3), "strong", actor="me")
    run = registry.runs.begin(LEAGUE, "run", algorithm="ppo", settings={}, seed=0, target=10, parent=1)
    registry.runs.record(LEAGUE, "run", RunPoint(LEAGUE, "run", 5, {"return": 1.0}, run.began_at))
    registry.runs.end(LEAGUE, "run", "ended")
    for version, opponent in ((1, "script:random"), (2, f"{LEAGUE}@3"), (3, "script:random")):
        registry.strength.record([replace(STRENGTH, version=version, opponent=opponent)])
    registry.nightly_runs.close(registry.nightly_runs.open(LEAGUE, [3], 0.05).id, {})
    registry.training_nights.open(LEAGUE)
    registry.traffic.set(LEAGUE, shadow=Portion(1, 0.5), actor="me", reason="")
    registry.traffic.set(LEAGUE, shadow=None, actor="me", reason="")
    return registry


def test_canaries_and_candidates_of_a_nightly_run_are_in_use(registry: Registry) -> None:
    registered(registry, versions=3)
    registry.nightly_runs.open(LEAGUE, [2], 0.05)
    registry.traffic.set(LEAGUE, canary=Portion(1, 0.5), actor="me", reason="")
    for number, reason in ((1, "it is the canary"), (2, "nightly run 1 tests it")):
        with pytest.raises(Conflict, match=reason):
            registry.removal.remove_version(CheckpointRef(LEAGUE, number))
    plan = registry.removal.plan_version(CheckpointRef(LEAGUE, 3))
    assert plan.versions[3] > 256
    assert registry.removal.remove_version(CheckpointRef(LEAGUE, 3)) == plan
    registry.removal.remove_version(CheckpointRef(LEAGUE, 1), force=True, actor="ada")
    setting = registry.traffic.current(LEAGUE)
    assert (setting.canary, setting.actor, setting.reason) == (None, "ada", f"{LEAGUE}@1 was removed")


def move(registry: Registry, version: int, expected: int | None, verdict: str | None) -> None:
    registry.aliases.set(LEAGUE, "champion", version, expected=expected, actor="me", reason="", verdict=verdict)


def test_a_version_on_which_something_depends_is_kept(used: Registry) -> None:
    for number, reasons in (
        (2, ("the alias champion points to it", "1 verdict (0f3a62d1)", "recorded match")),
        (1, ("1 version trained from it (@2)", "1 training run that uses it (run)", "1 verdict", "recorded match")),
    ):
        before = rows_of(used, LEAGUE)
        with pytest.raises(Conflict) as refused:
            used.removal.remove_version(CheckpointRef(LEAGUE, number))
        for reason in (f"{LEAGUE}@{number} is in use", "--force", *reasons):
            assert reason in str(refused.value)
        assert rows_of(used, LEAGUE) == before


def test_exploiters_that_were_trained_for_a_verdict_are_in_use(used: Registry) -> None:
    publish(used, "run/4")
    verdict = f"{LEAGUE}-verdict-1f3a62d1c8b45e97-1b2c3d4e"
    schedule = f"{LEAGUE}-exploitability-1"
    Ledger(used).open(replace(SCHEDULE, id=schedule, league=LEAGUE, contestants=(f"{LEAGUE}@3", f"{LEAGUE}@4")))
    tests = [{"kind": "exploitability", "schedule": schedule}]
    used.verdicts.open(LEAGUE, 3, f"{LEAGUE}@2", verdict, SETTINGS | {"tests": tests})
    used.verdicts.close(verdict, "reject", {})
    with pytest.raises(Conflict, match=r"1 verdict \(1f3a62d1\)"):
        used.removal.remove_version(CheckpointRef(LEAGUE, 4))
    used.removal.remove_version(CheckpointRef(LEAGUE, 4), force=True)
    assert [row.id for row in used.verdicts.all(LEAGUE)] == [VERDICT]


def test_force_removes_what_depends_on_a_version(used: Registry) -> None:
    used.removal.remove_version(CheckpointRef(LEAGUE, 3), force=True)
    assert used.verdicts.all(LEAGUE) == []
    assert [row.version for row in used.strength.of_run(LEAGUE, "run")] == [1]
    assert Ledger(used).counts(LEAGUE) == {}
    assert [(event.version, event.verdict) for event in used.aliases.history(LEAGUE)] == [(2, None), (1, None)]
    assert used.aliases.rollback(LEAGUE, actor="me", reason="").version == 1, "version 3 was in between"
    assert leftovers(used) == []


def test_matches_between_other_contestants_stay(used: Registry) -> None:
    round_robin = replace(SCHEDULE, league=LEAGUE, contestants=(f"{LEAGUE}@1", f"{LEAGUE}@3", "script:random"))
    ledger = Ledger(used)
    ledger.open(round_robin)
    for position, (one, other) in enumerate(round_robin.pairings):
        assert play_match(round_robin, position).contestants == tuple(
            round_robin.contestants[index] for index in (one, other)
        )
        ledger.extend([play_match(round_robin, position)])
    plan = used.removal.remove_version(CheckpointRef(LEAGUE, 3), force=True)
    assert plan.matches == 2 + 2, "those of the verdict, and those of the version in the round robin"
    assert [match.contestants for match in ledger.matches(league=LEAGUE)] == [(f"{LEAGUE}@1", "script:random")]
    assert ledger.recount(round_robin) == [], "the sums over the other matches are deleted"
    assert ledger.counts(LEAGUE) == {round_robin.id: 1}


def test_force_removes_the_champion_and_its_alias(used: Registry) -> None:
    before = used.changes.counts()
    plan = used.removal.remove_version(CheckpointRef(LEAGUE, "champion"), force=True)
    assert used.changes.counts().aliases == before.aliases + 1, "replicas follow"
    assert (plan.target, plan.aliases) == (f"{LEAGUE}@2", ("champion",))
    with pytest.raises(NothingToRollBack, match="alias champion of league tictactoe is not set: promote"):
        used.aliases.rollback(LEAGUE, actor="me", reason="")
    for number in (1, 3):
        used.removal.remove_version(CheckpointRef(LEAGUE, number), force=True)
    assert used.runs.get(LEAGUE, "run").parent is None
    with used.database.read() as session:
        assert session.execute(text("PRAGMA foreign_key_check")).all() == []


def leftovers_of_removed(registry: Registry) -> list[str]:
    directory = registry.artifacts.root / LEAGUE
    return [path.name for path in directory.iterdir()] if directory.exists() else []


STRENGTH = StrengthRow(
    league=LEAGUE,
    run="run",
    version=1,
    opponent="",
    steps=5,
    games=8,
    score=0.5,
    low=0.3,
    high=0.7,
    at=datetime.now(UTC),
)


def test_a_league_in_use_is_removed_by_force_only(used: Registry) -> None:
    directory = used.storage.home / "runs" / LEAGUE / "run"
    directory.mkdir(parents=True)
    of_other = rows_of(used, OTHER)
    with pytest.raises(Conflict, match=r"the alias champion is set; 1 verdict \(0f3a62d1\); 2 recorded matches; 1 tra"):
        used.removal.remove_league(LEAGUE)
    before = used.changes.counts()
    plan = used.removal.remove_league(LEAGUE, force=True)
    assert used.changes.counts() == before._replace(
        aliases=before.aliases + 1, traffic=before.traffic + 1, leagues=before.leagues + 1
    )
    assert (set(plan.versions), plan.matches, plan.runs) == ({1, 2, 3}, 2, ("run",))
    assert rows_of(used, LEAGUE) == {}
    assert rows_of(used, OTHER) == of_other
    assert not directory.parent.exists()
    assert leftovers_of_removed(used) == []
    assert verified(used, 1, OTHER)


def test_an_interrupted_removal_leaves_an_archived_league_and_can_be_completed(
    used: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ProcessDeath), crash_after(1, monkeypatch):
        used.removal.remove_league(LEAGUE, force=True)
    assert used.leagues.names()[LEAGUE] is not None
    assert rows_of(used, LEAGUE) == {"leagues": 1, "versions": 3}
    assert used.versions.all(LEAGUE) == []
    with pytest.raises(LeagueArchived):
        publish(used, "run/9")
    used.removal.remove_league(LEAGUE)
    assert LEAGUE not in used.leagues.names()
    assert leftovers_of_removed(used) == []


def test_a_member_of_a_mixture_is_not_removed_before_the_mixture(registry: Registry) -> None:
    publish(registry, "run/1")
    publish(registry, "run/2")
    mixture = registry.publisher.publish_mixture(LEAGUE, {1: 0.5, 2: 0.5})
    member = CheckpointRef(LEAGUE, 1)
    assert f"it is a part of the mixture @{mixture.number}" in registry.removal.plan_version(member).reasons
    with pytest.raises(Conflict, match=rf"{LEAGUE}@1 is a part of {mixture.ref}: remove that first"):
        registry.removal.remove_version(member, force=True)
    registry.removal.remove_version(CheckpointRef(LEAGUE, mixture.number))
    registry.removal.remove_version(member)
    assert [row.number for row in registry.versions.all(LEAGUE)] == [2]


def rows_of(registry: Registry, league: str) -> dict[str, int]:
    """Table → number of rows of a league, without empty tables."""
    columns = {table.name: table.c.get("league", table.c.get("slug")) for table in Base.metadata.sorted_tables}
    with registry.database.read() as session:
        counts = {
            name: session.scalar(select(func.count()).where(column == league)) or 0
            for name, column in columns.items()
            if column is not None
        }
    return {name: count for name, count in counts.items() if count}


def test_nothing_is_removed_during_training_or_an_evaluation(registry: Registry) -> None:
    registered(registry, versions=1)
    registry.runs.begin(LEAGUE, "active", algorithm="ppo", settings={}, seed=0, target=10)
    with pytest.raises(Conflict, match="training run active of league tictactoe is active"):
        registry.removal.remove_version(CheckpointRef(LEAGUE, 1), force=True)
    registry.runs.end(LEAGUE, "active", "stopped")
    registry.evaluations.submit(LEAGUE, {"kind": "gauntlet"}, actor="me", max_active=1)
    with pytest.raises(Conflict, match="evaluation 1 of league tictactoe is queued"):
        registry.removal.remove_league(LEAGUE, force=True)


def test_a_removal_of_a_version_is_completed_by_the_next_publication(
    used: Registry, monkeypatch: pytest.MonkeyPatch
) -> None:
    for writes, number in ((1, 3), (2, 1)):
        with pytest.raises(ProcessDeath), crash_after(writes, monkeypatch):
            used.removal.remove_version(CheckpointRef(LEAGUE, number), force=True)
        assert number not in [row.number for row in used.versions.all(LEAGUE)]
        assert publish(used, f"run/after {number}").number == 5 - writes % 2
        assert leftovers(used) == []
