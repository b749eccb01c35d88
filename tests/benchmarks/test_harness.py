"""Targets, recorded results and the page of them; the entry of all benchmarks; faults that are injected."""

import ast
import inspect
import math
import runpy
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks import __main__ as entry
from benchmarks import harness
from benchmarks.harness import Run, Target, chosen, in_rounds, record, recorded, write
from benchmarks.mutants import mutants

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


HEAVY = {"formats", "pages", "fuzz", "hostile", "exploitability", "training_nights", "exploiters"}
"""Their imports need packages that only some tests have, or take long."""


def test_every_benchmark_is_listed_and_has_a_quick_form(subtests: pytest.Subtests) -> None:
    listed = CliRunner().invoke(entry.app, ["--help"]).output
    assert [name for name in [*entry.names(), "all"] if f"  {name} " not in listed] == []
    for name in sorted(set(entry.names()) - HEAVY):
        with subtests.test(name):
            module = import_module(f"benchmarks.{name}")
            assert inspect.signature(module.main).parameters["quick"].default is False
            assert module.__doc__


def test_an_unknown_part_is_refused() -> None:
    result = CliRunner().invoke(entry.app, ["phases", "chess"])
    assert result.exit_code == 2
    assert "no part chess: expected some of leduc_holdem_dqn" in result.output


def test_a_missed_target_ends_with_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    met, missed = Target("rate", 1.2, "×", at_least=1.0, peer="a"), Target("wait", (0.1, 3.0), "s", at_most=1)
    entry.report(iter([met]), save=False)
    with pytest.raises(entry.typer.Exit):
        entry.report(iter([met, missed]), save=False)
    assert "wait: 0.1, 3 s   (target ≤1 s: MISSED)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "after"),
    [
        ("a < b", ["(a <= b)"]),
        ("a and not b", ["(a or not b)", "bool(b)"]),
        ("é = '–' or x + 1", ["('–' and x + 1)", "(x - 1)", "2"]),
        ("f(True)", ["pass", "False"]),
        ("def f(a: int = 1) -> int:\n    '''One.'''\n    return a", ["2", "return None"]),
        ("def f(a: Literal[1]) -> Literal[2]:\n    pass", []),
        ("if TYPE_CHECKING:\n    import a\n    b = 1", []),
    ],
)
def test_every_fault_of_a_module_is_a_module(source: str, after: list[str]) -> None:
    faults = list(mutants("a.py", source))
    assert sorted(fault.after for fault in faults) == sorted(after)
    for fault in faults:
        mutant = (source.encode()[: fault.start] + fault.after.encode() + source.encode()[fault.end :]).decode()
        ast.parse(mutant)
        assert mutant != source
        assert source.encode()[fault.start : fault.end].decode() == fault.before


@pytest.mark.slow
def test_the_quick_form_finds_no_partial_version_and_few_bytes() -> None:
    command = [sys.executable, "-m", "benchmarks", "object_store", "--quick"]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=200)
    lines = dict(line.partition(": ")[::2] for line in process.stdout.splitlines())
    assert lines["partial versions visible"].startswith("0 "), process.stderr
    assert float(lines["received for a version of 1 MB"].split()[0]) <= 2
