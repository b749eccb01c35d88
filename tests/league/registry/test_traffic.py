"""Settings of canary and shadow, what shadows have shown, and waiting for replicas to follow."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import update

from league.errors import Conflict, InvalidInput, KeyReused, NotReady, UnknownAlias, UnknownLeague, UnknownVersion
from league.histograms import BOUNDS
from league.registry.aliases import ANY
from league.registry.following import await_traffic
from league.registry.idempotency import Call
from league.registry.registry import Registry
from league.registry.rows import Portion, Shadowing, Traffic
from league.registry.tables import Report
from tests.league.registry.examples import LEAGUE, registered

EMPTY = (0,) * (len(BOUNDS) + 1)


@pytest.fixture
def versioned(registry: Registry) -> Registry:
    return registered(registry, LEAGUE, versions=3)


def put(registry: Registry, **portions: Portion | None) -> Traffic:
    return registry.set_traffic(LEAGUE, actor="ada", reason="test", **portions)


def test_what_is_not_named_stays(versioned: Registry) -> None:
    assert versioned.traffic(LEAGUE) == Traffic(LEAGUE)
    put(versioned, canary=Portion(2, 0.05))
    put(versioned, shadow=Portion(3, 1.0))
    now = versioned.traffic(LEAGUE)
    assert (now.canary, now.shadow, now.actor, now.reason) == (Portion(2, 0.05), Portion(3, 1.0), "ada", "test")
    put(versioned, canary=None)
    assert versioned.all_traffic() == {LEAGUE: versioned.traffic(LEAGUE)}
    assert [(one.canary, one.shadow) for one in versioned.traffic_history(LEAGUE)] == [
        (None, Portion(3, 1.0)),
        (Portion(2, 0.05), Portion(3, 1.0)),
        (Portion(2, 0.05), None),
    ]


def test_the_same_again_is_no_event(versioned: Registry) -> None:
    first = put(versioned, canary=Portion(2, 0.05))
    assert put(versioned, canary=Portion(2, 0.05)) == first
    assert len(versioned.traffic_history(LEAGUE)) == 1


def test_an_alias_stays_one(versioned: Registry) -> None:
    versioned.set_alias(LEAGUE, "candidate", 2, expected=ANY, actor="test", reason="test")
    assert put(versioned, shadow=Portion("candidate", 1.0)).shadow == Portion("candidate", 1.0)


def test_only_versions_that_there_are_get_traffic(versioned: Registry) -> None:
    for portion, error in (
        (Portion(9, 0.1), UnknownVersion),
        (Portion("candidate", 0.1), UnknownAlias),
        (Portion("champion", 0.1), InvalidInput),
        (Portion(2, 1.5), InvalidInput),
        (Portion(2, float("nan")), InvalidInput),
    ):
        with pytest.raises(error):
            put(versioned, canary=portion)
    with pytest.raises(UnknownLeague):
        versioned.set_traffic("nobody", canary=None, actor="ada", reason="test")
    assert versioned.traffic_history(LEAGUE) == []


def test_a_call_that_comes_again_gets_the_same_setting(versioned: Registry) -> None:
    key, _ = versioned.create_key("bot", ["promote"])
    call = Call(owner=key.id, key="first", digest="0" * 64)

    def set_it(share: float, call: Call) -> Traffic:
        return versioned.set_traffic(LEAGUE, canary=Portion(2, share), actor="bot", reason="test", call=call)

    first = set_it(0.1, call)
    put(versioned, canary=None)
    assert set_it(0.1, call) == first
    assert versioned.traffic(LEAGUE).canary is None
    with pytest.raises(KeyReused):
        set_it(0.2, replace(call, digest="1" * 64))


def shadowing(candidate: int = 2, requests: int = 10, **counts: int) -> Shadowing:
    whole = {"observations": 2 * requests, "agreed": requests, "failed": 0, "dropped": 0, "skipped": 0} | counts
    latency = (requests, *EMPTY[1:])
    return Shadowing(LEAGUE, candidate, 1, requests, **whole, latency=latency, ns=requests * 1000)


def test_what_replicas_have_seen_is_added_up_and_outlives_them(versioned: Registry) -> None:
    versioned.report("replica-1", {}, [shadowing(requests=5)])
    versioned.report("replica-1", {}, [shadowing(requests=10, dropped=3), shadowing(candidate=3)])
    versioned.report("replica-2", {}, [shadowing(requests=20, failed=1)])
    versioned.forget("replica-2")
    first, second = versioned.shadowings(LEAGUE)
    assert first == replace(shadowing(requests=30), dropped=3, failed=1)
    assert (first.agreement, first.milliseconds(0.95)) == (0.5, BOUNDS[0] / 1000)
    assert second == shadowing(candidate=3)
    assert replace(first, observations=0).agreement is None


def test_reports_are_the_newest_of_replicas_that_live(versioned: Registry) -> None:
    versioned.report("replica-1", {"a": 1})
    versioned.report("replica-1", {"a": 2})
    versioned.report("replica-2", {"b": 1})
    versioned.report("replica-3", {"c": 1})
    versioned.forget("replica-2")
    with versioned.database.write() as session:
        session.execute(
            update(Report).filter_by(replica="replica-3").values(at=datetime.now(UTC) - timedelta(minutes=1))
        )
    assert versioned.reports() == {"replica-1": {"a": 2}}


def test_waiting_for_replicas_to_follow(versioned: Registry) -> None:
    setting = put(versioned, canary=Portion(2, 0.05))
    with pytest.raises(NotReady, match="is a server running"):
        await_traffic(versioned, setting, 0)
    versioned.acknowledge("replica-1", LEAGUE, 1, "0" * 64, "2: shared.onnx was changed", {"champion": 1}, None)
    with pytest.raises(NotReady, match=r"replica-1 2: shared\.onnx was changed"):
        await_traffic(versioned, setting, 0)
    versioned.acknowledge("replica-1", LEAGUE, 1, "0" * 64, None, {"champion": 1, "2": 2}, setting.id)
    assert await_traffic(versioned, setting, 0) == ["replica-1"]
    put(versioned, canary=None)
    with pytest.raises(Conflict, match="set otherwise"):
        await_traffic(versioned, setting, 0)
