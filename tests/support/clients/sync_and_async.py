"""The synchronous and the asynchronous client behind one interface."""

import asyncio
import inspect
from collections.abc import Callable
from typing import Any

from policy_league_client import Client
from tests.support.servers.replicas import READ_ONLY

SETTINGS = READ_ONLY.model_copy(update={"max_body": 512 * 1024})


Connect = Callable[..., Client]


class Synchronous:
    """Wraps an AsyncClient, stream or episode: each method runs until its result is ready, so that a test covers both
    clients.
    """

    def __init__(self, awaited: Any, runner: asyncio.Runner) -> None:
        self._awaited = awaited
        self._runner = runner

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._awaited, name)
        if not callable(attribute):
            return attribute
        return lambda *args, **options: self._result_of(attribute(*args, **options))

    def __enter__(self) -> "Synchronous":
        self._runner.run(self._awaited.__aenter__())
        return self

    def __exit__(self, *error: Any) -> None:
        self._runner.run(self._awaited.__aexit__(*error))

    def _result_of(self, result: Any) -> Any:
        if inspect.iscoroutine(result):
            return self._runner.run(result)
        return Synchronous(result, self._runner) if hasattr(result, "__aenter__") else result
