"""Settings of canary and shadow, shadow statistics, and waiting for replicas."""

from dataclasses import replace
from datetime import timedelta

import pytest
from sqlalchemy import update

from league.errors import Conflict, InvalidInput, NotReady, UnknownAlias, UnknownVersion
from league.histograms import BOUNDS
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.database import clock
from league.registry.storage.rows import Portion, ShadowCounts, Traffic
from league.registry.storage.tables import ReplicaReportTable
from tests.support.databases import on_both_databases
from tests.support.leagues.acknowledgements import acknowledge
from tests.support.leagues.registries import LEAGUE, registered, traffic_history

EMPTY = (0,) * (len(BOUNDS) + 1)


@pytest.fixture
def versioned(registry: Registry) -> Registry:
    return registered(registry, LEAGUE, versions=3)


def set_traffic(registry: Registry, **portions: Portion | None) -> Traffic:
    return registry.traffic.set(LEAGUE, actor="ada", reason="test", **portions)


def test_only_existing_versions_get_traffic(versioned: Registry) -> None:
    for portion, error in (
        (Portion(9, 0.1), UnknownVersion),
        (Portion("candidate", 0.1), UnknownAlias),
        (Portion("champion", 0.1), InvalidInput),
        (Portion(2, 1.5), InvalidInput),
        (Portion(2, float("nan")), InvalidInput),
    ):
        with pytest.raises(error):
            set_traffic(versioned, canary=portion)
    assert traffic_history(versioned) == []


def shadow_counts(candidate: int = 2, requests: int = 10, **counts: int) -> ShadowCounts:
    fields = {"observations": 2 * requests, "agreed": requests, "failed": 0, "dropped": 0, "skipped": 0} | counts
    latency = [requests, *EMPTY[1:]]
    return ShadowCounts(LEAGUE, candidate, 1, requests, **fields, latency=latency, ns=requests * 1000)


@on_both_databases
def test_shadow_counts_are_summed_and_outlive_their_replicas(versioned: Registry) -> None:
    versioned.replicas.write_report("replica-1", {}, [shadow_counts(requests=5)])
    versioned.replicas.write_report(
        "replica-1", {}, [shadow_counts(requests=10, dropped=3), shadow_counts(candidate=3)]
    )
    versioned.replicas.write_report("replica-2", {}, [shadow_counts(requests=20, failed=1)])
    versioned.replicas.remove("replica-2")
    first, second = versioned.traffic.shadow_counts(LEAGUE)
    assert first == replace(shadow_counts(requests=30), dropped=3, failed=1)
    assert (first.agreement, first.milliseconds(0.95)) == (0.5, BOUNDS[0] / 1000)
    assert second == shadow_counts(candidate=3)
    assert replace(first, observations=0).agreement is None


def test_reports_are_the_latest_of_live_replicas(versioned: Registry) -> None:
    versioned.replicas.write_report("replica-1", {"a": 1})
    versioned.replicas.write_report("replica-1", {"a": 2})
    versioned.replicas.write_report("replica-2", {"b": 1})
    versioned.replicas.write_report("replica-3", {"c": 1})
    versioned.replicas.remove("replica-2")
    with versioned.database.write() as session:
        earlier = clock(session) - timedelta(minutes=1)
        session.execute(update(ReplicaReportTable).filter_by(replica="replica-3").values(at=earlier))
    assert versioned.replicas.reports() == {"replica-1": {"a": 2}}


def test_waiting_for_replicas_to_follow(versioned: Registry) -> None:
    setting = set_traffic(versioned, canary=Portion(2, 0.05))
    with pytest.raises(NotReady, match="is a server running"):
        versioned.changes.wait_for_traffic(setting, 0)
    acknowledge(versioned, "replica-1", LEAGUE, 1, "0" * 64, "2: shared.onnx was changed", {"champion": 1}, None)
    with pytest.raises(NotReady, match=r"replica-1 2: shared\.onnx was changed"):
        versioned.changes.wait_for_traffic(setting, 0)
    acknowledge(versioned, "replica-1", LEAGUE, 1, "0" * 64, None, {"champion": 1, "2": 2}, setting.id)
    assert versioned.changes.wait_for_traffic(setting, 0) == ["replica-1"]
    set_traffic(versioned, canary=None)
    with pytest.raises(Conflict, match="was changed in the meantime"):
        versioned.changes.wait_for_traffic(setting, 0)


def test_a_setting_has_its_actor_and_reason(versioned: Registry) -> None:
    versioned.aliases.set(LEAGUE, "candidate", 3, expected=ANY, actor="test", reason="test")
    setting = set_traffic(versioned, canary=Portion(2, 0.05))
    assert (setting.actor, setting.reason) == ("ada", "test")
    assert set_traffic(versioned, canary=Portion(2, 0.05)) == setting, "unchanged"
    assert versioned.traffic.all() == {LEAGUE: setting}
    both = set_traffic(versioned, shadow=Portion("candidate", 1.0))
    assert (both.canary, both.shadow) == (Portion(2, 0.05), Portion("candidate", 1.0)), "what is not named remains"
    assert set_traffic(versioned, canary=None).shadow == both.shadow
    assert [(row.canary, row.shadow) for row in traffic_history(versioned)][::2] == [
        (None, both.shadow),
        (setting.canary, None),
    ]
