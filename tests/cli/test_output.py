import json
from io import StringIO

import pytest
from rich.console import Console

from evaluation.documents import Progress
from policy_league.cli import output


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch) -> StringIO:
    """What is printed outside a terminal, with a line for each event."""
    text = StringIO()
    monkeypatch.setattr(output, "console", Console(file=text))
    monkeypatch.setattr(output, "SECONDS_PER_LINE", 0.0)
    return text


def test_outside_a_terminal_progress_is_printed_as_lines(printed: StringIO) -> None:
    with output.GameProgress(quiet=False) as listener:
        listener(Progress("a against b", 0, 16))
        listener(Progress("a against b", 8, 16, moves_per_second=123456.7, llr=1.2))
        listener(Progress("a against b", 16, 16, nodes=1, cpus=2))
    assert printed.getvalue().splitlines() == [
        "a against b: 0/16 matches",
        "a against b: 8/16 matches  123,457 moves/s  LLR +1.20",
        "a against b: 16/16 matches  1 node, 2 CPUs",
    ]


def test_quiet_progress_prints_nothing(printed: StringIO) -> None:
    with output.GameProgress(quiet=True) as listener:
        listener(Progress("a against b", 8, 16))
    assert printed.getvalue() == ""


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
    shown = printed.getvalue()
    assert shown.count(SHOWN) >= 4
    assert not output.CONTROL.search(shown)
    output.emit({"name": UNTRUSTED})
    written = capsys.readouterr().out
    assert not output.CONTROL.search(written)
    assert json.loads(written) == {"name": UNTRUSTED}
