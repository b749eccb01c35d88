"""The tables of the commands in a terminal of 80 columns."""

import ast
import re
from datetime import UTC, datetime, timedelta
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from league.histograms import Histogram
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import ShadowCounts
from league.registry.traffic import write_shadow_counts
from policy_league import cli
from policy_league.cli import output
from policy_league.cli.doctor import Check
from tests.support.command import League
from tests.support.leagues import tictactoe

COLUMNS = 80
NOTE = "learns from the search, then plays against itself and the two champions before it"
COMMANDS = {
    "versions/listing": ("versions", "tictactoe"),
    "versions/aliases": ("history", "tictactoe"),
    "serving/traffic": ("traffic", "tictactoe"),
    "serving/replicas": ("replicas",),
    "serving/keys": ("keys", "list"),
    "versions/retire": ("retire", "--keep=1", "--days=0", "--dry-run"),
    "doctor": ("doctor",),
    "training/check_env": ("check-env", "simple_adversary", "--episodes=1"),
    "evaluation/exploitability": ("exploitability", "tictactoe@1", "--blocks=2", "--workers=0"),
    "evaluation/evaluate": ("evaluate", "tictactoe", "--blocks=2", "--workers=0"),
    "leagues/listing": ("list",),
    "leagues/comparison": ("compare", "20261124", "20261125"),
    "training/runs": ("runs", "tictactoe"),
    "evaluation/nightly": ("nightly", "tictactoe", "--workers=0"),
}
"""Module of `cli` → a command that prints its table."""


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> StringIO:
    """What is printed as tables in a terminal of 80 columns. Sentences are wrapped by the terminal."""
    printed, block = StringIO(), output._print_block
    monkeypatch.setattr(output.console, "width", COLUMNS)

    def record(columns: Any) -> None:
        with output.console.capture() as captured:
            block(columns)
        printed.write(captured.get())

    monkeypatch.setattr(output, "_print_block", record)
    return printed


@pytest.fixture
def used(registry: Registry) -> Registry:
    """A league with notes, an exploiter, a promotion by a verdict, a shadow, replicas and keys."""
    name = tictactoe.LEAGUE
    tictactoe.publish(registry, tictactoe.graph(wins=True), exploits="tictactoe@1")
    verdict = f"{name}-verdict-0f3a62d1c8b45e97-1b2c3d4e"
    registry.verdicts.open(name, 2, "script:random", verdict, {"gate": {"alpha": 0.05}})
    for number, of in ((1, None), (2, verdict)):
        registry.aliases.set(
            name, "champion", number, expected=of and 1, actor="league nightly", reason=NOTE, verdict=of
        )
        registry.versions.set_note(CheckpointRef(name, number), NOTE, actor="ada")
    registry.verdicts.close(verdict, "promote", {"promoted": True})
    for replica in ("policy-server-0/replica-1f0e2a7b", "policy-server-1/replica-77c01d2e"):
        registry.replicas.register(replica, {})
    counts = dict.fromkeys(("requests", "observations", "agreed"), 1_234_567)
    shadow = ShadowCounts(
        name, 3, 2, **counts, failed=12, dropped=1200, skipped=0, latency=tuple(Histogram().counts), ns=10**9
    )
    with registry.database.write() as session:
        write_shadow_counts(session, "policy-server-0/replica-1f0e2a7b", [shadow])
    for number, run in enumerate(("20261124-080000-aa12bc", "20261125-080000-de34f5")):
        settings = {"policies_to_train": [NOTE, number], "gamma": 0.99}
        registry.runs.begin(name, run, algorithm="ppo", settings=settings, seed=1, target=9000)
        registry.runs.end(name, run, "ended")
    until = datetime.now(UTC) + timedelta(days=90)
    registry.keys.create("everything", ["act", "read", "evaluate", "promote"], expires_at=until, rate=100.0)
    registry.keys.create("one-game", ["act"], only_leagues=[name])
    return registry


@pytest.mark.usefixtures("short_examinations")
@pytest.mark.parametrize("module", COMMANDS)
def test_tables_fit_80_columns(
    league: League, request: pytest.FixtureRequest, tables: StringIO, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    request.getfixturevalue("registry" if module == "evaluation/nightly" else "used")
    advice = f"tested with 6.0: pip install 'policy-league[postgres]'. {NOTE}"
    monkeypatch.setattr(
        "policy_league.cli.doctor.CHECKS", (lambda: iter([Check("protobuf", "note", "5.29.3", advice)]),)
    )
    result = league(*COMMANDS[module])
    assert result.code == 0, result.err
    lines = tables.getvalue().splitlines()
    assert lines
    assert max(map(len, lines)) <= COLUMNS
    cut = re.compile(r"tictactoe@|script:|0f3a62d?|policy-server-[01]|20\d\d-\d\d")
    assert not [word for word in tables.getvalue().split() if cut.fullmatch(word)], "references are not wrapped"


def test_the_commands_with_tables_are_complete() -> None:
    folder = Path(cli.__file__).parent
    printing = {
        path.relative_to(folder).with_suffix("").as_posix()
        for path in folder.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("table", "show_leaderboard")
    }
    # A sweep trains first; tests/cli/training/ prints its table.
    assert printing - {"output", "training/sweep"} == set(COMMANDS)


@pytest.mark.usefixtures("used")
def test_a_verdict_is_shown_with_its_short_id(league: League, tables: StringIO) -> None:
    assert league("history", tictactoe.LEAGUE).code == 0
    assert tables.getvalue().splitlines()[1].endswith("  0f3a62d1")
    assert "-verdict-" not in tables.getvalue()


CELLS = st.one_of(
    st.none(),
    st.integers(-(10**12), 10**12),
    st.floats(allow_nan=False, allow_infinity=False, width=16),
    st.text("ab[]@:-é字", max_size=24),
)


@given(st.data(), st.integers(1, 9), st.integers(1, 4))
def test_any_table_fits_and_only_prose_is_wrapped(data: st.DataObject, columns: int, rows: int) -> None:
    names = [f"column {index}" for index in range(columns)]
    cells = data.draw(st.lists(st.tuples(*[CELLS] * columns), min_size=rows, max_size=rows))
    printed = Console(file=StringIO(), width=COLUMNS, highlight=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(output, "console", printed)
        output.table([*names, "none", "note"], [(*row, None, NOTE) for row in cells], prose=["note"], optional=["none"])
    lines = printed.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert max(map(cell_len, lines)) <= COLUMNS
    assert not any("none" in line for line in lines)
    for name, column in zip(names, zip(*cells, strict=True), strict=True):
        assert any(name in line for line in lines)
        for value in column:
            assert any(output.text(value) in line for line in lines)
    assert sum(line.count("search,") for line in lines) == rows
