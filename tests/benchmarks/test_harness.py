"""Targets, recorded results and the page of them."""

import math
import runpy
from pathlib import Path

import pytest

from benchmarks import harness
from benchmarks.harness import Run, Target, chosen, in_rounds, record, recorded, write

PAGE = runpy.run_path("scripts/benchmark_page.py")["page"]


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    monkeypatch.setitem(PAGE.__globals__, "RESULTS", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("target", "met", "limit"),
    [
        (Target("a", 2, at_least=2), True, "≥2"),
        (Target("a", (3.0, 1.0), "s", at_most=2.0), False, "≤2 s"),
        (Target("a", 95, "%", at_least=94, at_most=96), True, "≥94 %, ≤96 %"),
        (Target("a", math.nan, "×", at_least=1), False, "≥1×"),
        (Target("a", math.inf), True, ""),
    ],
)
def test_all_numbers_of_a_target_must_be_within_its_limits(target: Target, met: bool, limit: str) -> None:
    assert target.met is met
    assert target.limit == limit


@pytest.mark.usefixtures("results")
def test_what_is_recorded_is_read_again() -> None:
    runs = [
        Run("2026-01-02", "a machine", "--pairs 3", (Target("rate", (1.5, 2), "×", at_least=1, peer="b", note="c"),))
    ]
    write("startup", runs)
    assert recorded("startup") == runs
    record("startup", "", [Target("wait", 3.0, "s"), Target("pace", 1.0, machine="another machine")])
    assert [target.name for run in recorded("startup") for target in run.targets] == ["rate", "wait", "pace"]
    assert [run.machine for run in recorded("startup")][::2] == ["a machine", "another machine"]


@pytest.mark.usefixtures("results")
def test_the_page_shows_the_newest_result_of_each_measurement() -> None:
    older = Run("2026-01-02", "one", "", (Target("rate", 1.5, "×", at_least=1), Target("wait", 9, "s", at_most=3)))
    newer = Run("2026-01-03", "other", "--quick", (Target("rate", 1.25, "×", at_least=1), Target("size", 3, "MB")))
    write("startup", [older, newer])
    page = PAGE()
    assert "2026-01-02, one:\n\n|measurement|value|target|\n|---|---:|---:|\n|wait|**9 s**|≤3 s|\n" in page
    assert "2026-01-03, other, `--quick`:\n\n|measurement|value|target|\n|---|---:|---:|\n|rate|1.25×|≥1×|\n" in page
    assert "1.5×" not in page
    assert "size" not in page.partition("## startup")[2]


def test_measurements_alternate_within_a_round() -> None:
    calls: list[str] = []

    def measure(name: str, value: float) -> float:
        calls.append(name)
        return value + len(calls)

    assert in_rounds({"a": lambda: measure("a", 0), "b": lambda: measure("b", 10)}, 3) == {"a": 3, "b": 14}
    assert "".join(calls) == "ababab"


def test_parts_are_all_or_those_that_are_named() -> None:
    parts = {"a": 1, "b": 2}
    assert chosen(None, parts) == parts
    assert chosen(["b"], parts) == {"b": 2}
