"""What is counted, and for how long it is kept."""

from serve_app.inference_protocol.statistics import KEPT, Statistics


def test_times_are_of_the_parts_of_a_request() -> None:
    entry = Statistics().entry("board", 1)
    entry.succeed(3, begun=0, found=1, read=10, ran=100, done=1000)
    entry.succeed(2, begun=0, found=0, read=1, ran=2, done=3)
    entry.fail(50)
    document = entry.document("board", 1)
    assert (document["inference_count"], document["execution_count"]) == (5, 2)
    assert document["inference_stats"] == {
        "success": {"count": 2, "ns": 1003},
        "fail": {"count": 1, "ns": 50},
        "queue": {"count": 0, "ns": 0},
        "compute_input": {"count": 2, "ns": 10},
        "compute_infer": {"count": 2, "ns": 91},
        "compute_output": {"count": 2, "ns": 901},
        "cache_hit": {"count": 0, "ns": 0},
        "cache_miss": {"count": 0, "ns": 0},
    }


def test_what_was_not_asked_for_longest_is_forgotten() -> None:
    statistics = Statistics()
    for version in range(1, KEPT + 1):
        statistics.entry("board", version)
    statistics.entry("board", 1).fail(1)
    statistics.entry("board", KEPT + 1)
    kept = statistics.documents("board")
    assert len(kept) == KEPT
    assert [document["version"] for document in kept[:2]] == ["1", "3"]
    assert statistics.documents("duo") == []
    assert [document["version"] for document in statistics.documents("board", 7)] == ["7"]
