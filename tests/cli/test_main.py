"""The command as a whole: help, start-up, output, tables in a terminal of 80 columns, and `league doctor`."""

import ast
import json
import os
import re
import runpy
import signal
import socket
import subprocess
import sys
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.console import Console

from evaluation.documents import Progress
from league import interruption
from league.histograms import Histogram
from league.refs import CheckpointRef
from league.registry.registry import Registry
from league.registry.storage.rows import ShadowCounts
from league.registry.traffic import write_shadow_counts
from policy_league import cli
from policy_league.cli import doctor, main, output
from policy_league.cli.demo import drawing
from policy_league.cli.doctor import Check
from policy_league.cli.main import SUBCOMMANDS, app
from serve_app.runtime import launch
from tests.support.command import League
from tests.support.leagues import tictactoe

COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def test_the_commands_are_complete() -> None:
    assert set(COMMANDS) == {
        "doctor", "check-env", "train", "sweep", "versions", "note", "evaluate", "promote", "rollback", "history",
        "nightly", "replay", "serve", "act", "demo", "replicas", "keys", "traffic", "verify", "void", "report",
        "retire", "import", "export", "exploitability", "list", "archive", "remove", "compare", "init", "runs",
        "mixture", "recount", "export-games", "search",
    }  # fmt: skip


def test_the_package_is_the_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["league", "versions", "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_module("policy_league", run_name="__main__")
    assert end.value.code == 0
    assert "List a league's versions" in capsys.readouterr().out


def test_each_command_and_option_has_help() -> None:
    for name in sorted(COMMANDS):
        command = COMMANDS[name]
        assert len(command.help) > 40, name
        for part in (command, *getattr(command, "commands", {}).values()):
            assert part.help, f"{name} {part.name} has no help"
            for parameter in part.params:
                if parameter.name != "help":
                    assert getattr(parameter, "help", None), f"{name} {parameter.name} has no help"
    for name, listed in SUBCOMMANDS.items():
        assert listed.help == COMMANDS[name].help.partition("\n\n")[0].replace("\n", " "), "its first paragraph"


@pytest.mark.usefixtures("registry")
def test_a_cluster_that_does_not_exist_is_a_usage_error(league_process: League) -> None:
    """In a subprocess, since a process that is connected to Ray already does not connect again."""
    result = league_process("evaluate", "tictactoe", "--address", "127.0.0.1:1")
    assert (result.code, result.out) == (2, "")
    assert result.err.startswith("league: no Ray cluster at '127.0.0.1:1'")
    assert result.err.count("\n") == 1


def test_an_unusable_home_is_reported_in_one_line(league: League, home: Path) -> None:
    home.write_text("a file, where a directory is wanted")
    result = league("versions", "tictactoe")
    assert result.code == 1
    assert result.err.count("\n") == 1
    assert "home" in result.err


def test_folders_named_like_packages(league_process: League, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in ("configs", "training", "evaluation", "league"):
        (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path)
    result = league_process("train", "--help")
    assert (result.code, result.err) == (0, "")


LARGE_PACKAGES = "alembic gymnasium httpx league.config.league numpy onnxruntime pettingzoo ray scipy sqlalchemy torch"


IMPORTED = """
import sys
from typer.testing import CliRunner
from policy_league.cli.main import SUBCOMMANDS, app
for arguments in ARGUMENTS:
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
print(sorted(sys.modules.keys() & set(PACKAGES.split())))
"""


@pytest.mark.parametrize(
    ("arguments", "allowed"),
    [([["--help"], *([name, "--help"] for name in SUBCOMMANDS)], []), ([["versions", "tictactoe"]], ["sqlalchemy"])],
    ids=["help", "versions of a league without games"],
)
def test_few_packages_are_imported(
    home: Path, registry: Registry, arguments: list[list[str]], allowed: list[str]
) -> None:
    program = f"ARGUMENTS, PACKAGES = {arguments!r}, {LARGE_PACKAGES!r}\n{IMPORTED}"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"LEAGUE_HOME": str(home)},
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == str(allowed)


def test_json_is_alone_on_stdout_although_the_environment_prints(league_process: League, tmp_path: Path) -> None:
    (tmp_path / "talkative.py").write_text("from pettingzoo.classic.tictactoe_v3 import env\n\nprint('hello')\n")
    config = tmp_path / "talkative.yaml"
    config.write_text("league: talkative\nenvironment: {entry_point: 'talkative:env'}\n")
    result = league_process("check-env", str(config), "--json")
    assert result.json["policies"], result.out
    assert "hello" in result.err


def test_code_of_a_user_does_not_end_a_command_silently(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "app", lambda: sys.exit(0))
    with pytest.raises(SystemExit) as end:
        main.run()
    assert end.value.code == 1
    assert re.fullmatch(rf"league: {re.escape(__file__)}, line \d+ called sys\.exit\(\)\n", capsys.readouterr().err)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_command_in_order(
    number: signal.Signals, league: League, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interruption, "_last_signal", signal.SIGINT)
    closed: list[str] = []

    def interrupted() -> None:
        with ExitStack() as stack:
            stack.callback(closed.append, "environment")
            signal.raise_signal(number)

    monkeypatch.setattr("policy_league.cli.leagues.listing.open_registry", interrupted)
    result = league("list")
    assert (result.code, result.out, result.err.strip(), closed) == (128 + number, "", "", ["environment"])


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> StringIO:
    """What is printed outside a terminal, with a line for each event."""
    text = StringIO()
    monkeypatch.setattr(output, "console", Console(file=text))
    monkeypatch.setattr(output, "SECONDS_PER_LINE", 0.0)
    return text


def test_outside_a_terminal_progress_is_printed_as_lines_unless_it_is_quiet(printed: StringIO) -> None:
    with output.GameProgress(quiet=True) as listener:
        listener(Progress("a against b", 8, 16))
    with output.GameProgress(quiet=False) as listener:
        listener(Progress("a against b", 0, 16))
        listener(Progress("a against b", 8, 16, moves_per_second=123456.7, llr=1.2))
        listener(Progress("a against b", 16, 16, nodes=1, cpus=2))
    assert printed.getvalue().splitlines() == [
        "a against b: 0/16 matches",
        "a against b: 8/16 matches  123,457 moves/s  LLR +1.20",
        "a against b: 16/16 matches  1 node, 2 CPUs",
    ]


UNTRUSTED = "safe\u202eevil\u2066\u200f\x1b[2J\x9b31m\u2028\r[bold]"
"""Reverses the direction of text, clears a terminal, changes its colour, returns to the start of a line; has markup."""


SHOWN = "safe�evil���[2J�31m��[bold]"


def test_text_of_others_controls_neither_the_terminal_nor_the_direction_of_text(
    printed: StringIO, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "errors", output.console)
    output.say(UNTRUSTED)
    output.complain(UNTRUSTED)
    output.table(("name",), [(UNTRUSTED,)])
    with output.GameProgress(quiet=False) as listener:
        monkeypatch.setattr(output, "SECONDS_PER_LINE", 0.0)
        listener(Progress(UNTRUSTED, 1, 2))
        listener(Progress(UNTRUSTED, 2, 2))
    text = printed.getvalue()
    assert text.count(SHOWN) >= 4
    assert not output.CONTROL.search(text)
    output.emit({"name": UNTRUSTED})
    written = capsys.readouterr().out
    assert not output.CONTROL.search(written)
    assert json.loads(written) == {"name": UNTRUSTED}


def test_a_board_of_the_demo_is_drawn_with_its_columns() -> None:
    planes = np.zeros((2, 3, 2), np.int8)
    planes[1, 0, 0] = planes[1, 2, 1] = 1
    assert drawing(planes) == "· · ·\n● · ○\n0 1 2"


@pytest.mark.slow
def test_all_checks_of_doctor_pass(league_process: League) -> None:
    result = league_process("doctor", "--json")
    document = result.json
    statuses = {check["what"]: check["status"] for check in document["checks"]}
    assert {"Python", "ray", "torch", "CPU", "GPU", "LEAGUE_HOME", "disk", "registry", "Ray", "HAProxy"} <= set(
        statuses
    )
    assert document["ok"], document
    assert result.code == 0


def test_doctor_explains_a_broken_home(league: League, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CHECKS", (doctor._home, doctor._registry))
    home.mkdir()
    (home / "league.db").write_text("no database")
    document = league("doctor", "--json").json
    broken = [check for check in document["checks"] if check["status"] == "fail"]
    assert [check["what"] for check in broken] == ["registry"]
    assert "LEAGUE_HOME" in broken[0]["advice"]


def test_a_missing_optional_package_is_a_note(league: League, monkeypatch: pytest.MonkeyPatch) -> None:
    present = {name: version for name, version in doctor.VERIFIED.items() if name not in ("rlcard", "onnx")}
    monkeypatch.setattr(doctor, "installed", lambda: present)
    monkeypatch.setattr(doctor, "CHECKS", (doctor._stack,))
    statuses = {check["what"]: check["status"] for check in league("doctor", "--json").json["checks"]}
    assert statuses.pop("rlcard") == "note"
    assert statuses.pop("onnx") == "fail"
    assert set(statuses.values()) == {"ok"}


def test_the_ports_are_those_of_the_deployment(league: League, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CHECKS", (doctor._ports,))
    monkeypatch.setattr(launch, "DEPLOY_YAML", deploy := tmp_path / "deploy.yaml")
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_server(("127.0.0.1", 0)) as other:
        busy, free = (listener.getsockname()[1] for listener in (server, other))
        other.close()
        deploy.write_text(f"http_options: {{port: {free}}}\ngrpc_options: {{port: {busy}}}\n")
        http, grpc = league("doctor", "--json").json["checks"]
    assert (http["what"], http["status"], http["found"]) == ("serving HTTP", "ok", f"port {free} is free")
    assert (grpc["what"], grpc["status"], grpc["found"]) == ("serving gRPC", "note", f"port {busy} is in use")
    assert "--grpc-port PORT" in grpc["advice"]


COLUMNS = 80


NOTE = "learns from the search, then plays against itself and the two champions before it"


TABLES = {
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
        name, 3, 2, **counts, failed=12, dropped=1200, skipped=0, latency=Histogram().counts, ns=10**9
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
@pytest.mark.parametrize("module", TABLES)
def test_tables_fit_80_columns(
    league: League, request: pytest.FixtureRequest, tables: StringIO, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    request.getfixturevalue("registry" if module == "evaluation/nightly" else "used")
    advice = f"tested with 6.0: pip install 'policy-league[postgres]'. {NOTE}"
    monkeypatch.setattr(
        "policy_league.cli.doctor.CHECKS", (lambda: iter([Check("protobuf", "note", "5.29.3", advice)]),)
    )
    result = league(*TABLES[module])
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
    assert printing - {"output", "training/sweep"} == set(TABLES)


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
