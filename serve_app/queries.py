"""What stands behind a question mark, and in a path: pages of lists, numbers, instants, names. Refused in one way."""

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import TypeVar

from starlette.requests import Request

from league.errors import InvalidInput, NotFound

Row = TypeVar("Row")
Cursor = TypeVar("Cursor")

PAGE, LARGEST_PAGE = 50, 200
"""Rows of a list, where none are asked for and at most."""
LARGEST = 2**31 - 1
LONGEST = 300
"""Characters of a name or a cursor."""


def number(request: Request, name: str, largest: int = LARGEST, smallest: int = 1) -> int | None:
    """A whole number of the query. Raises InvalidInput."""
    text = request.query_params.get(name)
    if text is None:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= 10 and smallest <= int(text) <= largest):
        raise InvalidInput(f"{name} must be a number from {smallest} to {largest}, got {text[:32]!r}")
    return int(text)


def limit(request: Request) -> int:
    """How many rows a page of a list shall have. Raises InvalidInput."""
    return number(request, "limit", LARGEST_PAGE) or PAGE


def name(request: Request, key: str) -> str | None:
    """A name of the query: what it is called by, or a cursor. Raises InvalidInput."""
    text = request.query_params.get(key)
    if text is not None and not _is_name(text):
        raise InvalidInput(f"{key} must be 1 to {LONGEST} printable characters, got {text[:32]!r}")
    return text


def instant(request: Request, key: str) -> datetime | None:
    """An instant of the query, in UTC. Raises InvalidInput."""
    text = request.query_params.get(key)
    if text is None:
        return None
    try:
        found = datetime.fromisoformat(text)
        if found.tzinfo is not None:
            return found.astimezone(UTC)
    except (ValueError, OverflowError):
        pass
    raise InvalidInput(f"{key} must be an instant with its time zone, as 2026-03-03T14:00:00Z is, got {text[:40]!r}")


def named(request: Request, key: str, unknown: type[NotFound]) -> str:
    """A name of the path. Raises `unknown` for one that nothing can have."""
    text: str = request.path_params[key]
    if not _is_name(text):
        raise unknown(f"nothing is called {text[:32]!r}")
    return text


def paged(rows: Sequence[Row], limit: int, cursor: Callable[[Row], Cursor]) -> tuple[Sequence[Row], Cursor | None]:
    """A page of `rows`, of which one more was asked for than it holds, and what stands for its end if there is more."""
    page = rows[:limit]
    return page, cursor(page[-1]) if len(rows) > limit else None


def _is_name(text: str) -> bool:
    """Whether databases take it: PostgreSQL refuses text with a zero in it."""
    return text.isprintable() and 1 <= len(text) <= LONGEST
