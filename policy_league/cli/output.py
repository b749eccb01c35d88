"""Output of the commands: text, tables, progress bars and JSON."""

import json
import re
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from datetime import datetime
from typing import TYPE_CHECKING, Any, TextIO

import orjson
import typer
from rich.cells import cell_len
from rich.console import Console, JustifyMethod
from rich.table import Table
from rich.text import Text

from league.errors import InvalidInput
from league.refs import short_verdict

if TYPE_CHECKING:
    from evaluation.documents import Progress as Games
    from evaluation.documents import Standing
    from evaluation.gating.evidence import VerdictReport
    from evaluation.gating.nightly import NightlyListener
    from league.registry.registry import Registry

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)
CONTROL = re.compile(
    r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufff9-\ufffb\ud800-\udfff]"
)
"""Characters that control a terminal, the direction of text or lines. They are replaced, because names, reasons and
notes are untrusted: text after them could look like another one."""


def emit(document: Any) -> None:
    """Print one JSON document and nothing else."""
    text = orjson.dumps(document, option=orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY).decode()
    if (_documents or sys.stdout).encoding.lower() != "utf-8":
        text = json.dumps(orjson.loads(text), indent=2)  # ASCII
    print(CONTROL.sub(lambda match: f"\\u{ord(match[0]):04x}", text), file=_documents, flush=True)


_documents: TextIO | None = None
"""Where `emit` prints; None: stdout."""


@contextmanager
def only_json_on_stdout() -> Iterator[None]:
    """While the context lasts, redirect prints to stderr, except those of `emit`: environments and bots may print."""
    global _documents
    _documents = sys.stdout
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _documents = None


def say(sentence: str = "") -> None:
    """Print text without interpreting square brackets as markup."""
    console.print(CONTROL.sub("�", sentence), markup=False, soft_wrap=True)


def complain(sentence: str) -> None:
    """Print an error or a warning to stderr."""
    errors.print(CONTROL.sub("�", sentence), markup=False, soft_wrap=True)


def confirm(
    question: str,
    *,
    yes: bool,
    as_json: bool = False,
    hint: str = "without a terminal, confirm with --yes, or use --dry-run",
    reason: str | None = None,
) -> None:
    """Ask for confirmation, unless --yes gave it. Ends the command if it is refused.

    reason: why it is asked, in a sentence before the question. Raises InvalidInput with `hint` without a terminal, or
    with --json.
    """
    if not yes:
        if as_json or not sys.stdin.isatty():
            raise InvalidInput(hint)
        if reason:
            say(reason)
        typer.confirm(question, abort=True)


def warn_of_changed_game(registry: "Registry", league: str) -> None:
    """Say if the results of a league are of its game before a change that no command has registered yet."""
    if (change := registry.leagues.unregistered_change(league)) is not None:
        complain(
            f"{league}: {change}. These results are of the game before. The next `league evaluate`, `league nightly` or"
            " `league train` registers the change, and results of the new game count from then on."
        )


MEGABYTE = 10**6
GAP = 2
"""Spaces between the columns of a table."""
NARROWEST_PROSE = 16
"""Columns below which text is not wrapped."""


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    *,
    prose: Collection[str] = (),
    optional: Collection[str] = (),
) -> None:
    """Print a table that fits the terminal. Numeric columns are aligned to the right.

    Only prose is wrapped. If the columns do not fit side by side, the table continues below, with its first column
    repeated.

    Args:
        columns: The headers.
        rows: The values of each row.
        prose: Columns of text that may be wrapped.
        optional: Columns that are left out if no row has a value.
    """
    by_column = list(zip(*rows, strict=True)) or [()] * len(columns)
    first, *other_columns = [
        _Column(name, values)
        for name, values in zip(columns, by_column, strict=True)
        if name not in optional or any(value not in (None, "") for value in values)
    ]
    label = min(first.width, console.width // 2)
    blocks: list[list[tuple[_Column, int]]] = [[(first, label)]]
    for column in other_columns:
        width = min(column.least if column.name in prose else column.width, console.width - label - GAP)
        if len(blocks[-1]) > 1 and _total(blocks[-1]) + GAP + width > console.width:
            blocks.append([(first, label)])
        blocks[-1].append((column, width))
    for number, block in enumerate(blocks):
        if number:
            console.print()
        _print_block(_widened(block, console.width))


class _Column:
    """A column of a table. `width`: of its widest cell. `least`: the narrowest one that does not break words."""

    def __init__(self, name: str, values: Sequence[Any]) -> None:
        self.name, self.cells = name, [text(value) for value in values]
        is_numeric = bool(values) and all(isinstance(value, int | float | None) for value in values)
        self.justify: JustifyMethod = "right" if is_numeric else "left"
        self.width = max(map(cell_len, (name, *self.cells)))
        words = (word for cell in (name, *self.cells) for word in cell.split())
        self.least = min(self.width, max(NARROWEST_PROSE, *map(cell_len, words)))


def _total(block: Sequence[tuple[_Column, int]]) -> int:
    return sum(width for _, width in block) + GAP * (len(block) - 1)


def _widened(block: Sequence[tuple[_Column, int]], limit: int) -> list[tuple[_Column, int]]:
    """Give the rest of the line to the columns that are narrower than their text, from left to right."""
    spare, widened_block = limit - _total(block), []
    for column, width in block:
        more = min(spare, column.width - width)
        spare -= more
        widened_block.append((column, width + more))
    return widened_block


def _print_block(block: Sequence[tuple[_Column, int]]) -> None:
    sheet = Table(box=None, pad_edge=False, header_style="bold", padding=(0, GAP, 0, 0))
    for column, width in block:
        sheet.add_column(Text(column.name), justify=column.justify, overflow="fold", width=width)
    for row in zip(*(column.cells for column, _ in block), strict=True):
        sheet.add_row(*map(Text, row))
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
    return CONTROL.sub("�", str(value))


def counted(number: int, noun: str) -> str:
    """Format a number of things: `1 game`, `2 games`."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


def elo(rating: float | None, interval: Sequence[float] | None) -> str | None:
    """Format a rating and its interval as `+123 [+100, +150]`."""
    if rating is None:
        return None
    span = f" [{interval[0]:+.0f}, {interval[1]:+.0f}]" if interval else ""
    return f"{rating:+.0f}{span}"


SECONDS_PER_LINE, SECONDS_PER_UPDATE = 10.0, 0.5
"""Between two lines of progress, where there is no bar, and two updates of a spinner."""


@contextmanager
def progress(title: str) -> Iterator[Callable[[str], None]]:
    """Return a function that shows what is done now, which may be called often: beside a spinner in a terminal, in
    plain lines elsewhere.
    """
    with errors.status(Text(title)) if errors.is_terminal else nullcontext() as status:
        interval = SECONDS_PER_LINE if status is None else SECONDS_PER_UPDATE
        next_time = time.monotonic() + interval

        def show(doing: str) -> None:
            nonlocal next_time
            if time.monotonic() >= next_time:
                next_time = time.monotonic() + interval
                if status is None:
                    complain(f"{title}: {doing}")
                else:
                    status.update(Text(text(f"{title}: {doing}")))

        yield show


class GameProgress:
    """Context manager that returns a listener, which prints verdicts and the progress: a bar in a terminal, plain lines
    elsewhere.
    """

    def __init__(self, quiet: bool) -> None:
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        self._quiet, self._has_bar = quiet, console.is_terminal and not quiet
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
        )
        self._task = self._bar.add_task("", total=None, note="")
        self._next_line = time.monotonic() + SECONDS_PER_LINE

    def __enter__(self) -> "NightlyListener":
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
        from evaluation.documents import Progress as Games

        if not isinstance(event, Games):
            for line in (f"  {verdict(event)}", f"    {event.reason}", event.remedy and f"    {event.remedy}"):
                if line:
                    say(line)
            return
        places = None if event.nodes is None else f"{counted(event.nodes, 'node')}, {counted(event.cpus or 0, 'CPU')}"
        speed = None if event.moves_per_second is None else f"{event.moves_per_second:,.0f} moves/s"
        llr = None if event.llr is None else f"LLR {event.llr:+.2f}"
        note = "  ".join(filter(None, (places, speed, llr)))
        self._bar.update(self._task, description=text(event.what), completed=event.played, total=event.of, note=note)
        if not self._has_bar and time.monotonic() >= self._next_line:
            self._next_line = time.monotonic() + SECONDS_PER_LINE
            line = f"{event.what}: {event.played}/{event.of} matches  {note}"
            say(line.rstrip())


def show_leaderboard(leaderboard: "tuple[Standing, ...]", explanation: str | None = None) -> None:
    """Print a leaderboard. explanation: why its first is not the champion."""
    table(
        ("contestant", "rating [95 %]", "score", "mean return", "games"),
        [
            (
                standing.ref,
                elo(standing.rating, standing.interval),
                standing.score,
                standing.mean_return,
                standing.games,
            )
            for standing in leaderboard
        ],
    )
    if explanation:
        say(explanation)


def verdict(report: "VerdictReport") -> str:
    """`0f3a62d1: connect_four@2 against connect_four@1: promote after 40 games (40 unique), score 0.710, …`"""
    score = "–" if report.score is None else f"{report.score:.3f}"
    low, high = report.bounds
    games = f"after {report.games} games ({report.unique_games} unique), score {score}"
    place = f"LLR {report.llr:+.2f} in [{low:+.2f}, {high:+.2f}]"
    gap = f", returns differ by {report.difference}" if report.difference else ""
    further = "".join(f"; {test.finding}" for test in report.further)
    who = f"{short_verdict(report.verdict)}: {report.candidate} against {report.opponent}"
    forfeits = "".join(f"; {ref} forfeited {lost}" for ref, lost in report.forfeits.items())
    return f"{who}: {report.outcome} {games}, {place}{gap}{further}{forfeits}"
