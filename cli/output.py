"""Output of the commands: text, tables, progress bars and JSON."""

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import TYPE_CHECKING, Any

import orjson
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from evaluation.results import Difference, Listener, Standing, VerdictReport
    from evaluation.results import Progress as Games

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Terminal control characters. They are removed because names, reasons and notes are untrusted."""


def emit(document: Any) -> None:
    """Print one JSON document and nothing else."""
    print(orjson.dumps(document, option=orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY).decode())


def say(sentence: str = "") -> None:
    """Print text without interpreting square brackets as markup."""
    console.print(CONTROL.sub("�", sentence), markup=False, soft_wrap=True)


def complain(sentence: str) -> None:
    """Print an error or a warning to stderr."""
    errors.print(CONTROL.sub("�", sentence), markup=False, soft_wrap=True)


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table with headers. Numeric columns are aligned to the right."""
    sheet = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    rows = [tuple(row) for row in rows]
    for index, column in enumerate(columns):
        numeric = bool(rows) and all(isinstance(row[index], int | float | None) for row in rows)
        sheet.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        sheet.add_row(*(text(value) for value in row))
    console.print(sheet)


def text(value: Any) -> str:
    """Format one cell of a table."""
    match value:
        case None:
            return "–"
        case datetime():
            return value.astimezone().strftime("%Y-%m-%d %H:%M:%S")
        case float():
            return f"{value:.3f}"
        case tuple() | list():
            return ", ".join(text(item) for item in value)
    return CONTROL.sub("�", str(value)).replace("[", r"\[")


def elo(rating: float | None, interval: Sequence[float] | None) -> str | None:
    """Format a rating and its interval as `+123 [+100, +150]`."""
    if rating is None:
        return None
    span = f" [{interval[0]:+.0f}, {interval[1]:+.0f}]" if interval else ""
    return f"{rating:+.0f}{span}"


SECONDS_PER_LINE = 10.0
"""Seconds between two lines of progress, where there is no bar."""


class GameProgress:
    """Context manager that returns a listener, which prints verdicts and the progress: a bar in a terminal, plain lines
    elsewhere.
    """

    def __init__(self, quiet: bool) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._quiet, self._has_bar = quiet, console.is_terminal and not quiet
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task("", total=None, note="")
        self._next_line = time.monotonic() + SECONDS_PER_LINE

    def __enter__(self) -> "Listener":
        if self._has_bar:
            self._bar.start()
        return self._show

    def __exit__(self, *_: object) -> None:
        # Stopping a bar that was not started prints an empty line.
        if self._has_bar:
            self._bar.stop()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Hide the bar while another one is shown."""
        if self._has_bar:
            self._bar.stop()
        yield
        if self._has_bar:
            self._bar.start()

    def _show(self, event: "Games | VerdictReport") -> None:
        if self._quiet:
            return
        from evaluation.results import VerdictReport

        if isinstance(event, VerdictReport):
            console.print(f"  {verdict(event)}", markup=False, soft_wrap=True)
            return
        note = _note(event)
        self._bar.update(self._task, description=event.what, completed=event.played, total=event.of, note=note)
        if not self._has_bar and time.monotonic() >= self._next_line:
            self._next_line = time.monotonic() + SECONDS_PER_LINE
            line = f"{event.what}: {event.played}/{event.of} matches  {note}"
            console.print(line.rstrip(), markup=False, soft_wrap=True)


def _note(event: "Games") -> str:
    """`25,000 moves/s  LLR +1.20`"""
    speed = None if event.moves_per_second is None else f"{event.moves_per_second:,.0f} moves/s"
    llr = None if event.llr is None else f"LLR {event.llr:+.2f}"
    return "  ".join(filter(None, (speed, llr)))


def show_leaderboard(leaderboard: "tuple[Standing, ...]") -> None:
    """Print a leaderboard."""
    table(
        ("contestant", "rating [95 %]", "score", "mean return", "games"),
        [(each.ref, elo(each.rating, each.interval), each.score, each.mean_return, each.games) for each in leaderboard],
    )


def verdict(report: "VerdictReport") -> str:
    """`connect_four@2 against connect_four@1: promote after 40 games (40 unique), score 0.710, LLR +2.97 in […]`"""
    score = "–" if report.score is None else f"{report.score:.3f}"
    low, high = report.bounds
    games = f"after {report.games} games ({report.unique_games} unique), score {score}"
    place = f"LLR {report.llr:+.2f} in [{low:+.2f}, {high:+.2f}]"
    gap = f", returns differ by {difference(report.difference)}" if report.difference else ""
    anchors = "".join(
        f"; {each.outcome} to {each.ref} by {each.margin:g} after {each.games} games" for each in report.anchors
    )
    exploiters = "".join(
        f"; against {each.ref} {each.outcome} than {report.opponent} by {each.margin:g} after {each.games} games"
        for each in report.exploiters
    )
    note = f": {report.note}" if report.note else ""
    who = f"{report.candidate} against {report.opponent}"
    return f"{who}: {report.outcome} {games}, {place}{gap}{anchors}{exploiters}{note}"


def difference(gap: "Difference") -> str:
    """`+1.5 [0.9, 2.1]`"""
    span = "" if gap.low is None or gap.high is None else f" [{gap.low:.4g}, {gap.high:.4g}]"
    return f"{gap.mean:+.4g}{span}"
