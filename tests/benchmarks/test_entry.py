"""`python -m benchmarks` runs every benchmark, all of which have a quick form."""

import inspect
from importlib import import_module

import pytest
from typer.testing import CliRunner

from benchmarks import __main__ as entry
from benchmarks.harness import Target

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
