"""Notifications of changes on a connection to PostgreSQL."""

import os
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from sqlalchemy import Engine, event

CHANNEL = "league_changes"


class Listener:
    """Listens for changes on the only connection of an engine. With SQLite there are no notifications."""

    def __init__(self, engine: Engine) -> None:
        self.on_change: Callable[[], object] = lambda: None
        """Called in the thread of the connection, for a notification that arrives during a statement."""
        self.opened = 0
        """Number of connections so far: after a new one, anything may have changed."""
        self._engine = engine
        self._connection: Any = None
        event.listen(engine, "connect", self._open)
        event.listen(engine, "close", self._close)

    def socket(self) -> int | None:
        """A descriptor of the connection's socket, which is readable after a notification. The caller closes it.

        None if there is no connection now, or if there are no notifications.
        """
        connection = self._connection
        if connection is None:
            return None
        assert self._engine.dialect.dbapi is not None
        try:
            return os.dup(connection.fileno())
        except (OSError, self._engine.dialect.dbapi.Error):
            return None  # closed in the meantime

    def discard(self) -> None:
        """Discard the notifications that have arrived: what is read afterwards contains their changes.

        Called in the thread of the connection.
        """
        connection = self._connection
        if connection is None:
            return
        assert self._engine.dialect.dbapi is not None
        with suppress(self._engine.dialect.dbapi.Error):  # the next statement reports a lost connection
            connection.pgconn.consume_input()
            while connection.pgconn.notifies() is not None:
                pass

    def _open(self, connection: Any, _: object) -> None:
        self.opened += 1
        if self._engine.dialect.name == "postgresql":
            connection.execute(f"LISTEN {CHANNEL}")
            connection.commit()
            connection.add_notify_handler(lambda _: self.on_change())
            self._connection = connection

    def _close(self, *_: object) -> None:
        self._connection = None
