"""Writes the access log: one JSON line per request, if the settings name a directory for it.

    {"time": "2026-03-03T14:00:00.123Z", "method": "POST", "route": "/v1/policies/connect_four/action",
     "policy": "connect_four", "version": 4, "status": 200, "us": 83, "key": "game-server"}

`us` is the time spent in the replica in microseconds. `key` is the name of the API key, never its text. A thread writes
the lines. If the disk is full, they are lost; requests are unaffected.
"""

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime
from io import TextIOWrapper
from logging import LogRecord, makeLogRecord
from logging.handlers import QueueListener, RotatingFileHandler
from pathlib import Path
from queue import SimpleQueue
from time import perf_counter_ns
from typing import Any

import orjson
from starlette.types import Message, Scope, Send

from serve_app.runtime.ray_serve import logger

MAX_WAITING = 20_000
"""Maximum number of lines that wait to be written; further ones are dropped."""
MAX_FILE_BYTES, BACKUP_COUNT = 64 * 2**20, 4
"""Size at which a file is rotated, and the number of rotated files that are kept."""
LOG_ENTRY = "league.access"
"""Scope entry of a logged request: the fields of its line."""


class AccessLog:
    """Writes `access-<replica>.jsonl` in a directory. All methods run on the event loop."""

    def __init__(self, directory: Path, replica: str) -> None:
        self._records = SimpleQueue[LogRecord]()
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
                if self._records.qsize() < MAX_WAITING:
                    self._records.put(makeLogRecord({"msg": line}))

        return noting

    @asynccontextmanager
    async def writing(self) -> AsyncIterator[None]:
        """Write lines while the context is active, and the remaining ones on exit."""
        listener = QueueListener(self._records, self._file)
        listener.start()
        try:
            yield
        finally:
            await asyncio.to_thread(listener.stop)
            self._file.close()


class _File(RotatingFileHandler):
    """A file that is opened, with its directory, when the first line is written."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, maxBytes=MAX_FILE_BYTES, backupCount=BACKUP_COUNT, delay=True)
        self._has_failed = False

    def _open(self) -> TextIOWrapper:
        Path(self.baseFilename).parent.mkdir(parents=True, exist_ok=True)
        return super()._open()

    def format(self, record: LogRecord) -> str:
        return orjson.dumps(record.msg, option=orjson.OPT_UTC_Z).decode()

    def flush(self) -> None:  # after each line
        super().flush()
        self._has_failed = False

    def handleError(self, _: LogRecord) -> None:  # noqa: N802
        if not self._has_failed:
            logger.error("cannot write the access log %s, lines are lost: %s", self.baseFilename, sys.exc_info()[1])
        self._has_failed = True
