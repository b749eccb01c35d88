"""Commands without what a shell provides: streams, encodings, a working directory, a home directory, a user's name."""

import io
import json
import os
import pwd
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from unittest import mock
from urllib.request import proxy_bypass

import pytest

from league.refs import CheckpointRef
from league.registry.registry import Registry
from policy_league.cli import doctor, main, output
from policy_league.cli.options import acting
from tests.support.command import League

DASH = "–"


@pytest.fixture
def streams(home: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """The command runs in this process; what it changes is restored."""
    monkeypatch.setenv("LEAGUE_HOME", str(home))
    monkeypatch.setattr(sys, "path", list(sys.path))
    for name in ("argv", "stdin", "stdout", "stderr"):
        monkeypatch.setattr(sys, name, getattr(sys, name))
    monkeypatch.setattr(output.console, "quiet", False)  # as Rich sets it when a reader has ended
    with mock.patch.dict(os.environ):
        yield monkeypatch


def code_of(*arguments: str) -> int:
    """Run the command, and return its exit code."""
    sys.argv = ["league", *arguments]
    with pytest.raises(SystemExit) as end:
        main.run()
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.mark.usefixtures("registry", "streams")
@pytest.mark.parametrize("arguments", [("list",), ("list", "--json"), ("--help",)], ids=" ".join)
def test_a_full_disk_behind_stdout(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with Path("/dev/full").open("w", encoding="utf-8") as sys.stdout:
        assert code_of(*arguments) == 1
    assert capsys.readouterr().err == "league: standard output cannot be written: No space left on device\n"


@pytest.mark.usefixtures("registry", "streams")
def test_a_full_disk_behind_stderr_changes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    full = sys.stderr = os.fdopen(os.open("/dev/full", os.O_WRONLY), "w", encoding="utf-8")
    assert code_of("versions", "unknown") == 2
    assert code_of("list") == 0
    assert "tictactoe" in capsys.readouterr().out
    with suppress(OSError):
        full.close()


@pytest.mark.usefixtures("registry", "streams")
def test_a_reader_that_has_ended(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["list"], ["list", "--json"], ["--help"]):
        reader, writer = os.pipe()
        os.close(reader)
        sys.stdout = os.fdopen(writer, "w", encoding="utf-8")
        assert code_of(*arguments) == 1
    assert capsys.readouterr().err == ""


@pytest.mark.usefixtures("registry", "streams")
def test_an_encoding_that_lacks_characters(tmp_path: Path, registry: Registry) -> None:
    registry.versions.set_note(CheckpointRef("tictactoe", 1), f"a{DASH}b\U0001f600", actor="a")
    printed = tmp_path / "out"
    with printed.open("w", encoding="latin-1") as sys.stdout:
        assert code_of("versions", "tictactoe") == 0
    assert "a?b?" in printed.read_text("latin-1")
    with printed.open("w", encoding="latin-1") as sys.stdout:
        assert code_of("versions", "tictactoe", "--json") == 0
    document = json.loads(printed.read_text("latin-1"))
    assert document["versions"][0]["note"]["text"] == f"a{DASH}b\U0001f600"


@pytest.mark.usefixtures("registry", "streams")
def test_closed_streams_are_opened(capsys: pytest.CaptureFixture[str]) -> None:
    sys.stdout, sys.stdin = None, None  # type: ignore[assignment]  as in a process that starts without them
    assert code_of("promote", "tictactoe@1") == 2
    assert "confirm with --yes" in capsys.readouterr().err
    assert code_of("list") == 0
    assert isinstance(sys.stdout, io.TextIOWrapper)
    assert os.get_inheritable(sys.stdout.fileno())


@pytest.mark.usefixtures("streams")
def test_a_working_directory_that_was_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "removed").mkdir()
    monkeypatch.chdir(tmp_path / "removed")
    (tmp_path / "removed").rmdir()
    assert code_of("list") == 2
    assert capsys.readouterr().err == "league: the working directory was removed: change to another one\n"


@pytest.mark.usefixtures("registry", "streams")
def test_no_library_uses_a_proxy_for_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NO_PROXY", "")
    assert code_of("list") == 0
    assert all(map(proxy_bypass, ("localhost", "127.0.0.1", "::1")))
    assert not proxy_bypass("models.example")
    monkeypatch.setenv("no_proxy", "models.example")
    assert code_of("list") == 0
    assert all(map(proxy_bypass, ("models.example", "127.0.0.1")))


@pytest.fixture
def nameless(streams: pytest.MonkeyPatch) -> None:
    """The user is not in the password database, and the environment names neither it nor its home."""

    def unknown(number: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {number}")

    streams.setattr(pwd, "getpwuid", unknown)
    for name in ("HOME", "LOGNAME", "USER", "LNAME", "USERNAME"):
        streams.delenv(name, raising=False)


@pytest.mark.usefixtures("nameless")
def test_a_user_without_a_name_acts_and_has_a_home(registry: Registry, home: Path) -> None:
    assert code_of("promote", "tictactoe@2", "--yes") == 0
    (event,) = registry.aliases.history("tictactoe", "champion")
    assert event.actor == acting(None) == f"uid {os.getuid()}"
    assert acting("ann") == "ann"
    assert Path.home() == home, "Ray looks for files there"


@pytest.mark.usefixtures("nameless")
def test_a_path_in_an_unknown_home(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("LEAGUE_HOME", "~/league")
    assert code_of("list") == 2
    assert capsys.readouterr().err == "league: ~/league: this user has no home directory: use an absolute path\n"


@pytest.mark.usefixtures("nameless")
def test_doctor_names_what_the_surroundings_lack(league: League, home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ALL_PROXY", "unknown://127.0.0.1")
    monkeypatch.setattr(doctor, "CHECKS", (doctor._user, doctor._terminal, doctor._proxies, doctor._home))
    home.symlink_to("/missing")
    checks = {check["what"]: check for check in league("doctor", "--json").json["checks"]}
    statuses = {what: check["status"] for what, check in checks.items()}
    assert statuses["user"] == statuses["HOME"] == statuses["proxy"] == "note"
    assert checks["user"]["found"] == f"uid {os.getuid()}"
    assert "ALL_PROXY" in checks["proxy"]["found"]
    assert (statuses["LEAGUE_HOME"], statuses["output"], statuses["SIGHUP"]) == ("fail", "ok", "ok")
    assert "a link to /missing, which does not exist" in checks["LEAGUE_HOME"]["advice"]
