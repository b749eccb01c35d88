"""An environment that owns an engine, such as a server: it must be closed."""

import sys
import time
from pathlib import Path
from typing import Any

from tests.support.environments.simultaneous import Simultaneous

RUNNING: list["Engine"] = []
"""The engines of this process."""


class Engine(Simultaneous):
    """Its engine starts with it and ends with `close`.

    `log`: a file to which it writes a line when the engine starts or ends.
    `most`: engines that a process can start, as with a fixed port.
    `closes`: `well`, or it `raises`, `exits` or `hangs` after its engine has ended.
    """

    def __init__(self, most: int | None = None, closes: str = "well", log: str | None = None) -> None:
        super().__init__()
        if most is not None and len(RUNNING) >= most:
            raise OSError("Address already in use")
        self.closes, self.log = closes, log
        RUNNING.append(self)
        self._note("starts")

    def close(self) -> None:
        RUNNING.remove(self)
        self._note("ends")
        match self.closes:
            case "raises":
                raise RuntimeError("no answer")
            case "exits":
                sys.exit(3)
            case "hangs":
                time.sleep(1000)

    def _note(self, event: str) -> None:
        if self.log is not None:
            with Path(self.log).open("a") as file:
                file.write(f"{event}\n")


def engine(**kwargs: Any) -> Engine:
    """The entry point for configurations."""
    return Engine(**kwargs)


def only_engine() -> Engine:
    """The entry point of an environment with a fixed port: there is one at a time."""
    return Engine(most=1)
