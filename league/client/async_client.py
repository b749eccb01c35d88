"""The client of a policy server for asyncio: what `Client` does, with `await`."""

import asyncio
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx

from league.client import calls
from league.client.answers import Answer, BatchAnswer
from league.client.calls import ANY, Call, Document, Promotion
from league.client.encoding import Encoding
from league.client.endpoint import LIMITS, URL, Endpoint
from league.client.episode import AsyncEpisode
from league.client.models import parse_model
from league.client.patience import LOOK, Attempts, Outcome
from league.client.questions import BatchQuestion, Question
from league.client.stream import AsyncStream
from league.errors import LeagueError, NotReady
from league.refs import CHAMPION

T = TypeVar("T")


class AsyncClient:
    """Calls a policy server; see `Client`, whose arguments and errors it shares. For one event loop."""

    def __init__(
        self,
        url: str = URL,
        *,
        key: str | None = None,
        caller: str | None = None,
        timeout: float = 5.0,
        patience: float = 10.0,
        encoding: Encoding = "base64",
    ) -> None:
        self.endpoint = Endpoint(url, key, caller, timeout)
        self.patience = patience
        self.encoding: Encoding = encoding
        self._http = httpx.AsyncClient(limits=LIMITS, verify=self.endpoint.is_encrypted)

    async def act(
        self,
        model: str,
        observation: Any,
        *,
        explore: bool = False,
        seed: int | None = None,
        probabilities: bool = False,
        state: str | None = None,
    ) -> Answer:
        """See `Client.act`."""
        question = Question.about(
            observation, self.encoding, explore=explore, seed=seed, probabilities=probabilities, state=state
        )
        return await self.send(calls.act(parse_model(model), question))

    async def act_batch(
        self,
        model: str,
        observations: Any,
        *,
        explore: bool = False,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
        state: Sequence[str | None] | None = None,
    ) -> BatchAnswer:
        """See `Client.act_batch`."""
        question = BatchQuestion.about(
            observations, self.encoding, explore=explore, seed=seed, probabilities=probabilities, state=state
        )
        return await self.send(calls.act_batch(parse_model(model), question))

    def episode(self, model: str, *, explore: bool = False, seed: int | None = None) -> AsyncEpisode:
        """An episode, whose actions are all of the version that gives the first one: see `Episode`."""
        return AsyncEpisode(self, parse_model(model), explore=explore, seed=seed)

    def stream(self, model: str, *, follow: bool = False) -> AsyncStream:
        """A WebSocket for a client that acts at every tick: see `Stream`."""
        return AsyncStream(self.endpoint, parse_model(model), self.patience, self.encoding, follow=follow)

    async def leagues(self) -> list[Document]:
        """See `Client.leagues`."""
        return await self.send(calls.leagues())

    async def league(self, league: str) -> Document:
        """See `Client.league`."""
        return await self.send(calls.league(league))

    async def versions(self, league: str) -> list[Document]:
        """See `Client.versions`."""
        return await self.send(calls.versions(league))

    async def aliases(self, league: str) -> dict[str, int]:
        """See `Client.aliases`."""
        return dict((await self.league(league))["aliases"])

    async def promote(
        self,
        ref: str,
        *,
        alias: str = CHAMPION,
        expected: int | None = ANY,
        reason: str | None = None,
        idempotency_key: str | None = None,
        wait: float = 0.0,
    ) -> Promotion:
        """See `Client.promote`."""
        moved = await self.send(calls.promote(ref, alias, expected, reason, idempotency_key))
        await self._await_followers(moved, wait)
        return moved

    async def rollback(
        self, league: str, *, reason: str | None = None, idempotency_key: str | None = None, wait: float = 0.0
    ) -> Promotion:
        """See `Client.rollback`."""
        moved = await self.send(calls.rollback(league, reason, idempotency_key))
        await self._await_followers(moved, wait)
        return moved

    async def evaluate(
        self,
        league: str,
        *,
        reason: str | None = None,
        idempotency_key: str | None = None,
        wait: float = 0.0,
        **asked: Any,
    ) -> Document:
        """See `Client.evaluate`."""
        told = await self.send(calls.evaluate(league, asked, reason, idempotency_key))
        deadline = time.monotonic() + wait
        while not calls.has_ended(told) and time.monotonic() < deadline:
            await asyncio.sleep(LOOK)
            told = await self.evaluation(league, told["evaluation"])
        return told

    async def evaluation(self, league: str, number: int) -> Document:
        """See `Client.evaluation`."""
        return await self.send(calls.evaluation(league, number))

    async def evaluations(self, league: str, *, before: int | None = None, limit: int = 20) -> list[Document]:
        """See `Client.evaluations`."""
        return await self.send(calls.evaluations(league, before, limit))

    async def stop_evaluation(self, league: str, number: int) -> Document:
        """See `Client.stop_evaluation`."""
        return await self.send(calls.stop_evaluation(league, number))

    async def is_live(self) -> bool:
        """See `Client.is_live`."""
        return await self._is("live")

    async def is_ready(self) -> bool:
        """See `Client.is_ready`."""
        return await self._is("ready")

    async def wait_until_ready(self, timeout: float = 60.0) -> None:
        """See `Client.wait_until_ready`."""
        deadline = time.monotonic() + timeout
        while not await self.is_ready():
            if time.monotonic() > deadline:
                raise NotReady(f"{self.endpoint.url} was not ready within {timeout:g} s")
            await asyncio.sleep(LOOK)

    async def send(self, call: Call[T]) -> T:
        """See `Client.send`."""
        attempts = Attempts(self.patience)
        while True:
            request = self.endpoint.request(call)
            try:
                outcome: Outcome = await self._http.send(request)
            except httpx.TransportError as error:
                outcome = error
            pause = attempts.pause(outcome)
            if pause is None:
                return self.endpoint.read(call, outcome)
            await asyncio.sleep(pause)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def _is(self, what: str) -> bool:
        call = calls.health(what)
        try:
            self.endpoint.read(call, await self._http.send(self.endpoint.request(call)))
        except (LeagueError, httpx.TransportError):
            return False
        return True

    async def _await_followers(self, moved: Promotion, timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while timeout and (late := calls.late(await self.league(moved.league), moved.alias, moved.version)):
            if time.monotonic() > deadline:
                raise NotReady(calls.not_everywhere(moved, timeout, late))
            await asyncio.sleep(LOOK)
