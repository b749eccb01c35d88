from io import StringIO

import pytest
from rich.console import Console

from cli import output
from evaluation.results import Progress


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
