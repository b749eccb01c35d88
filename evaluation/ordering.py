"""What is finished in any order comes out in its own: results follow from the schedule, and not from the clock."""

from __future__ import annotations

from typing import Generic, TypeVar

T = TypeVar("T")


class InOrder(Generic[T]):
    """Takes items by their place, 0, 1, …, and gives them back in order of place, each when all before it are there."""

    def __init__(self) -> None:
        self.due = 0
        """The place of the next item to come out."""
        self._waiting: dict[int, T] = {}

    def __len__(self) -> int:
        """How many wait for their turn."""
        return len(self._waiting)

    def put(self, place: int, item: T) -> None:
        """Take an item that is finished."""
        self._waiting[place] = item

    def take(self) -> T | None:
        """The next in order, None while that is not finished."""
        if self.due not in self._waiting:
            return None
        item = self._waiting.pop(self.due)
        self.due += 1
        return item
