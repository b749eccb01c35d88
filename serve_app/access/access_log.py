"""Writes the access log: one JSON line per request, if the settings name a directory for it.

    {"time": "2026-03-03T14:00:00.123Z", "method": "POST", "route": "/v1/policies/connect_four/action",
     "policy": "connect_four", "version": 4, "status": 200, "us": 83, "key": "game-server"}

`us` is the time spent in the replica in microseconds. `key` is the name of the API key, never its text. Lines
are written together, in a thread. If the disk is full, they are lost; requests are unaffected.
"""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from io import TextIOWrapper
from logging import LogRecord, makeLogRecord
from logging.handlers import RotatingFileHandler
from pathlib import Path
from time import perf_counter_ns
from typing import Any, cast

import orjson
from starlette.types import Message, Scope, Send

from serve_app.runtime.background import in_background
from serve_app.runtime.ray_serve import logger

WRITE_INTERVAL = 0.5
"""Seconds between two writes."""
MAX_WAITING = 20_000
"""Maximum number of lines that wait to be written; further ones are dropped."""
MAX_FILE_BYTES, BACKUP_COUNT = 64 * 2**20, 4
"""Size at which a file is rotated, and the number of rotated files that are kept."""
LOG_ENTRY = "league.access"
"""Scope entry of a logged request: the fields of its line."""


class AccessLog:
    """Writes `access-<replica>.jsonl` in a directory. All methods run on the event loop."""

    def __init__(self, directory: Path, replica: str) -> None:
        self._lines: list[dict[str, Any]] = []
        self._file = _File(directory / f"access-{replica}.jsonl")

    def begin(self, scope: Scope, path: str, send: Send) -> Send:
        """Start the entry of a request; returns a `send` that completes it."""
        start = perf_counter_ns()
        line: dict[str, Any] = {"time": None, "method": scope.get("method", scope["type"]), "route": path}
        line |= {"policy": None, "version": None, "status": None, "us": None, "key": None}
        scope[LOG_ENTRY] = line

        async def noting(message: Message) -> None:
            if message["type"] == "http.response.start":
                line["status"] = message["status"]
            await send(message)
            is_end = message["type"] == "http.response.body" and not message.get("more_body", False)
            if is_end or message["type"] == "websocket.close":
                line["time"], line["us"] = datetime.now(UTC), (perf_counter_ns() - start) // 1000
                if len(self._lines) < MAX_WAITING:
                    self._lines.append(line)

        return noting

    @asynccontextmanager
    async def writing(self) -> AsyncIterator[None]:
        """Write lines while the context is active, and the remaining ones on exit."""
        try:
            async with in_background(self._write_on()):
                yield
        finally:
            await self._write()
            self._file.close()

    async def _write_on(self) -> None:
        while True:
            await asyncio.sleep(WRITE_INTERVAL)
            await self._write()

    async def _write(self) -> None:
        lines, self._lines = self._lines, []
        if lines:
            await asyncio.to_thread(self._file.emit, makeLogRecord({"msg": lines}))


class _File(RotatingFileHandler):
    """A file that is opened, with its directory, when the first lines are written."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, maxBytes=MAX_FILE_BYTES, backupCount=BACKUP_COUNT, delay=True)
        self._has_failed = False

    def _open(self) -> TextIOWrapper:
        Path(self.baseFilename).parent.mkdir(parents=True, exist_ok=True)
        return super()._open()

    def format(self, record: LogRecord) -> str:
        return "\n".join(orjson.dumps(line, option=orjson.OPT_UTC_Z).decode() for line in cast(list[Any], record.msg))

    def flush(self) -> None:  # after each write
        super().flush()
        self._has_failed = False

    def handleError(self, _: LogRecord) -> None:  # noqa: N802
        if not self._has_failed:
            logger.error("cannot write the access log %s, lines are lost: %s", self.baseFilename, sys.exc_info()[1])
        self._has_failed = True
