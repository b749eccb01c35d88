"""What statistics count, and for how long they are kept."""

from serve_app.inference_protocol.statistics import MAX_ENTRIES, Statistics, sum_documents


def test_durations_are_of_the_parts_of_a_request() -> None:
    entry = Statistics().entry("board", 1)
    entry.succeed(3, begun=0, found=1, read=10, ran=100, done=1000)
    entry.succeed(2, begun=0, found=0, read=1, ran=2, done=3, executions=0)
    entry.fail(50)
    document = entry.document("board", 1)
    assert (document["inference_count"], document["execution_count"]) == (5, 1)
    assert document["inference_stats"] == {
        "success": {"count": 2, "ns": 1003},
        "fail": {"count": 1, "ns": 50},
        "queue": {"count": 2, "ns": 1},
        "compute_input": {"count": 2, "ns": 10},
        "compute_infer": {"count": 2, "ns": 91},
        "compute_output": {"count": 2, "ns": 901},
        "cache_hit": {"count": 0, "ns": 0},
        "cache_miss": {"count": 0, "ns": 0},
    }


def test_the_least_recently_used_entry_is_evicted() -> None:
    statistics = Statistics()
    for version in range(1, MAX_ENTRIES + 1):
        statistics.entry("board", version)
    statistics.entry("board", 1).fail(1)
    statistics.entry("board", MAX_ENTRIES + 1)
    kept = statistics.documents("board")
    assert len(kept) == MAX_ENTRIES
    assert [document["version"] for document in kept[:2]] == ["1", "3"]
    assert statistics.documents("duo") == []
    assert [document["version"] for document in statistics.documents("board", 7)] == ["7"]


def test_statistics_of_replicas_are_summed_by_model_and_version() -> None:
    replicas = [Statistics(), Statistics()]
    for number, statistics in enumerate(replicas, 1):
        statistics.entry("board", 1).succeed(number, begun=0, found=0, read=1, ran=3, done=6)
    replicas[1].entry("board", 2).fail(5)
    first, second = sum_documents([each for statistics in replicas for each in statistics.documents()])
    assert (first["version"], first["inference_count"], first["execution_count"]) == ("1", 3, 2)
    assert first["inference_stats"]["success"] == {"count": 2, "ns": 12}
    assert first["last_inference"] == max(each.documents("board", 1)[0]["last_inference"] for each in replicas)
    assert (second["version"], second["inference_stats"]["fail"]["count"]) == ("2", 1)
