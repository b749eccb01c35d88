"""Statistics of several replicas."""

from contextlib import ExitStack
from dataclasses import fields

from starlette.testclient import TestClient

from league.registry.registry import Registry
from league.registry.storage.rows import LeagueRow
from league.settings import Storage
from serve_app.app import Replica
from tests.support.servers.replicas import READ_ONLY, local_client

RARELY = READ_ONLY.model_copy(update={"heartbeat": 5.0})
TENSOR = {"name": "observation", "datatype": "FP32", "shape": [1, 2], "data": [0.5, 0.5]}


def infer(replica: TestClient) -> None:
    assert replica.post("/v2/models/vector/infer", json={"inputs": [TENSOR]}).status_code == 200


def count(replica: TestClient) -> int:
    (entry,) = replica.get("/v2/models/vector/versions/1/stats").json()["model_stats"]
    return int(entry["inference_stats"]["success"]["count"])


def test_a_league_of_another_release_is_left_out_of_the_index(leagues: Storage) -> None:
    registry = Registry.open(leagues)
    with local_client(Replica(Registry.open(leagues), RARELY, "catalogue-3")) as replica:
        before = replica.post("/v2/repository/index").json()
        for name, interface in (("configured", None), ("described", {"of": "another release"})):
            with registry.database.write() as session:
                row = session.get_one(LeagueRow, "board")
                values = {field.name: getattr(row, field.name) for field in fields(row)}
                values |= {"slug": name, "config_document": {"of": "another release"}}
                session.add(LeagueRow(**values | ({} if interface is None else {"interface_document": interface})))
        try:
            assert replica.post("/v2/repository/index").json() == before
            assert registry.leagues.action_selections().keys() >= {"board", "configured", "described"}, "replicas go on"
        finally:
            for name in ("configured", "described"):
                registry.removal.remove_league(name)
            registry.close()


def test_counts_never_decrease_from_one_replica_to_the_next(leagues: Storage) -> None:
    with ExitStack() as running:
        one, other = (
            running.enter_context(local_client(Replica(Registry.open(leagues), RARELY, name)))
            for name in ("catalogue-1", "catalogue-2")
        )
        before = count(other)
        for asked in (one, other, other, one, one):
            infer(asked)
            counts = [count(asked), count(one), count(other)]
            before += 1
            assert counts == [before] * 3
