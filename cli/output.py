"""What the commands print: tables and sentences for people, JSON for programs."""

import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import Any

import orjson
from rich.console import Console
from rich.table import Table

console = Console(highlight=False)
errors = Console(stderr=True, highlight=False)
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""What a terminal obeys instead of showing it. Names, reasons and notes come from other people."""


def emit(document: Any) -> None:
    """Print one JSON document and nothing else."""
    print(orjson.dumps(document, option=orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY).decode())


def say(sentence: str = "") -> None:
    """Print a sentence. Square brackets in it are text, not markup."""
    console.print(CONTROL.sub("�", sentence), markup=False, soft_wrap=True)


def complain(sentence: str) -> None:
    """Say on stderr what is wrong."""
    errors.print(CONTROL.sub("�", sentence), markup=False, soft_wrap=True)


def table(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print rows under column heads; numbers to the right."""
    sheet = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    rows = [tuple(row) for row in rows]
    for index, column in enumerate(columns):
        numeric = bool(rows) and all(isinstance(row[index], int | float | None) for row in rows)
        sheet.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        sheet.add_row(*(text(value) for value in row))
    console.print(sheet)


def text(value: Any) -> str:
    """One cell of a table."""
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
    """A rating with its interval, as `+123 [100, 150]`."""
    if rating is None:
        return None
    span = f" [{interval[0]:+.0f}, {interval[1]:+.0f}]" if interval else ""
    return f"{rating:+.0f}{span}"
