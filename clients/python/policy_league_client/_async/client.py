"""HTTP client for a policy server: actions, episodes, streams, versions, promotions and evaluations."""

import time
from collections.abc import Sequence
from typing import Any, Self, TypeVar

import httpx

from policy_league_client import calls
from policy_league_client._async.episode import AsyncEpisode
from policy_league_client._async.stream import AsyncStream
from policy_league_client.calls import ANY, ApiCall, Promotion
from policy_league_client.endpoint import DEFAULT_URL, Endpoint
from policy_league_client.errors import LeagueError, NotReady
from policy_league_client.refs import CHAMPION
from policy_league_client.requests import ActionRequest, BatchActionRequest, Encoding, JsonObject
from policy_league_client.responses import ActionResponse, BatchActionResponse, parse_model
from policy_league_client.retries import POLL_INTERVAL, Outcome, Retries
from policy_league_client.transport import async_sleep

T = TypeVar("T")


class AsyncClient:
    """Client for a policy server. Keeps its connections open; close it or use it as a context manager.

    Belongs to one event loop.

    Args:
        url: Base URL of the server.
        key: API key. Defaults to the environment variable `LEAGUE_API_KEY`; without either, no key is sent.
        caller: Identifies a player or an episode. During a canary release, requests of one caller are always answered
            by the same version; requests without a caller are answered by the champion. Of a mixture, requests of one
            caller are answered by the same member; those without a caller by a random one, with which an episode
            continues.
        timeout: Seconds allowed for one attempt. The server stops working on a request after the same time.
        retry_deadline: Seconds after the first attempt within which a failed request is retried if the server was
            unreachable or busy; 0 disables retries. Every request is safe to repeat: requests that change something
            carry an `Idempotency-Key`.
        encoding: Encoding of arrays in requests; see `policy_league_client.requests.Encoding`.

    Raises:
        InvalidInput: The URL, the key, the caller or the timeout is invalid, or a proxy that an environment variable
            names.

    Every method that sends a request raises the `LeagueError` that corresponds to the server's error code,
    `InvalidInput` or `InvalidReference` for arguments that cannot be sent, and `RemoteError` if the server is
    unreachable or fails.
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        key: str | None = None,
        caller: str | None = None,
        timeout: float = 5.0,
        retry_deadline: float = 10.0,
        encoding: Encoding = "base64",
    ) -> None:
        self.endpoint = Endpoint(url, key, caller, timeout)
        self.retry_deadline = retry_deadline
        self.encoding: Encoding = encoding
        self._http = self.endpoint.http_client(httpx.AsyncClient)

    async def act(
        self,
        model: str,
        observation: Any,
        *,
        explore: bool | None = None,
        seed: int | None = None,
        probabilities: bool = False,
        state: str | None = None,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> ActionResponse:
        """Request the action for one observation.

        Args:
            model: `LEAGUE[.POLICY][@VERSION]`: `connect_four`, `connect_four@3`, `duo.left@champion`.
            observation: An observation as the environment returns it: an array, a number, nested lists, or a dict of
                these (for example with the keys `observation` and `action_mask`).
            explore: Sample the action from the policy's distribution (True), or take the most likely one (False). By
                default, actions are selected as in the league's matches.
            seed: Seed for sampling. Without it, `explore` uses a random one, which the response contains.
            probabilities: Include the action probabilities in the response.
            state: Recurrent state of the previous response; None starts an episode. `episode` tracks it for you.
            deadline_ms: Milliseconds after which a search version plays the best action so far. Others ignore it.
            analysis: Include what the search expects in the response. Requires a search version.

        Returns:
            The action and the version that chose it.
        """
        request = ActionRequest.build(
            observation,
            self.encoding,
            explore=explore,
            seed=seed,
            probabilities=probabilities,
            state=state,
            deadline_ms=deadline_ms,
            analysis=analysis,
        )
        return await self.send(calls.act(parse_model(model), request))

    async def act_batch(
        self,
        model: str,
        observations: Any,
        *,
        explore: bool | None = None,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
        state: Sequence[str | None] | None = None,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> BatchActionResponse:
        """Request the actions for a batch of observations; one version answers all of them.

        Args:
            model: See `act`.
            observations: A list of observations, or arrays whose first axis is the batch.
            explore: See `act`.
            seed: One seed for the batch, or one for each observation.
            probabilities: See `act`.
            state: Recurrent state of each observation.
            deadline_ms: See `act`.
            analysis: See `act`.

        Returns:
            The actions, in the order of the observations.
        """
        request = BatchActionRequest.build(
            observations,
            self.encoding,
            explore=explore,
            seed=seed,
            probabilities=probabilities,
            state=state,
            deadline_ms=deadline_ms,
            analysis=analysis,
        )
        return await self.send(calls.act_batch(parse_model(model), request))

    def episode(self, model: str, *, explore: bool | None = None, seed: int | None = None) -> AsyncEpisode:
        """Start an episode, whose actions all come from one version; see `AsyncEpisode`."""
        return AsyncEpisode(self, parse_model(model), explore=explore, seed=seed)

    def stream(self, model: str, *, follow: bool = False) -> AsyncStream:
        """Create a WebSocket stream for a program that needs an action at every tick; see `AsyncStream`."""
        return AsyncStream(self.endpoint, parse_model(model), self.retry_deadline, self.encoding, follow=follow)

    async def leagues(self) -> list[JsonObject]:
        """Return all leagues with their aliases."""
        return await self.send(calls.leagues())

    async def league(self, league: str) -> JsonObject:
        """Return the aliases of a league, its policies with their spaces, and the versions that each replica serves."""
        return await self.send(calls.league(league))

    async def versions(self, league: str) -> list[JsonObject]:
        """Return the versions of a league in ascending order."""
        return await self.send(calls.versions(league))

    async def aliases(self, league: str) -> dict[str, int]:
        """Return the version number of each alias of a league."""
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
        """Point an alias at a version or a mixture. Requires the scope `promote`.

        Args:
            ref: The version, `connect_four@3`, or the versions of a mixture with their probabilities,
                `connect_four@3:0.6,@5:0.4`.
            alias: The alias to move.
            expected: The version that the alias must point to beforehand, None if it must not exist. By default the
                alias is moved unconditionally.
            reason: Text for the audit log.
            idempotency_key: A request with the same key is applied once. Defaults to a random key.
            wait: Seconds to wait until every replica serves the version; 0 returns at once. Waiting also requires the
                scope `read`.

        Returns:
            The promotion as recorded in the registry.

        Raises:
            AliasMoved: The alias does not point to `expected`.
            NotReady: A replica does not serve the version within `wait` seconds.
        """
        promotion = await self.send(calls.promote(ref, alias, expected, reason, idempotency_key))
        await self._wait_for_replicas(promotion, wait)
        return promotion

    async def rollback(
        self,
        league: str,
        *,
        expected: int = ANY,
        reason: str | None = None,
        idempotency_key: str | None = None,
        wait: float = 0.0,
    ) -> Promotion:
        """Restore the previous champion, if it is `expected` now. For arguments and errors see `promote`."""
        promotion = await self.send(calls.rollback(league, expected, reason, idempotency_key))
        await self._wait_for_replicas(promotion, wait)
        return promotion

    async def evaluate(
        self,
        league: str,
        *,
        reason: str | None = None,
        idempotency_key: str | None = None,
        wait: float = 0.0,
        **options: Any,
    ) -> JsonObject:
        """Start an evaluation. Requires the scope `evaluate`.

        Args:
            league: The league.
            reason: Text for the audit log.
            idempotency_key: A request with the same key starts one evaluation. Defaults to a random key.
            wait: Seconds to wait until the evaluation ends; 0 returns at once. Waiting also requires the scope `read`.
            options: Further fields of the body of `POST …/evaluations`: `contestants=["connect_four@3"], blocks=64`,
                or `kind="nightly"`.

        Returns:
            The evaluation, in the format of `GET …/evaluations/{evaluation}`.
        """
        status = await self.send(calls.evaluate(league, options, reason, idempotency_key))
        deadline = time.monotonic() + wait
        while not calls.has_ended(status) and time.monotonic() < deadline:
            await async_sleep(POLL_INTERVAL)
            status = await self.evaluation(league, status["evaluation"])
        return status

    async def evaluation(self, league: str, number: int) -> JsonObject:
        """Return the progress of an evaluation, with its result if it is `done`."""
        return await self.send(calls.evaluation(league, number))

    async def evaluations(self, league: str, *, before: int | None = None, limit: int = 20) -> list[JsonObject]:
        """Return at most `limit` evaluations of a league without results, newest first.

        before: return only evaluations with a smaller number.
        """
        return await self.send(calls.evaluations(league, before, limit))

    async def stop_evaluation(self, league: str, number: int) -> JsonObject:
        """Request the end of an evaluation, which takes a few seconds. An ended evaluation is not changed."""
        return await self.send(calls.stop_evaluation(league, number))

    async def is_live(self) -> bool:
        """Return whether a replica responds. Sends one request, without retries."""
        return await self._check_health("live")

    async def is_ready(self) -> bool:
        """Return whether a replica has loaded the versions of all aliases. Sends one request, without retries."""
        return await self._check_health("ready")

    async def wait_until_ready(self, timeout: float = 60.0) -> None:
        """Wait until a replica is ready. Raises NotReady if none is within `timeout` seconds."""
        deadline = time.monotonic() + timeout
        while not await self.is_ready():
            if time.monotonic() > deadline:
                raise NotReady(f"{self.endpoint.url} was not ready within {timeout:g} s")
            await async_sleep(POLL_INTERVAL)

    async def send(self, call: ApiCall[T]) -> T:
        """Send an API call, retry it after temporary failures, and return its parsed response."""
        retries = Retries(self.retry_deadline)
        while True:
            request = self.endpoint.request(call)
            try:
                outcome: Outcome = await self._http.send(request)
            except httpx.TransportError as error:
                outcome = error
            delay = retries.next_delay(outcome)
            if delay is None:
                return self.endpoint.parse(call, outcome)
            await async_sleep(delay)

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def _check_health(self, probe: str) -> bool:
        call = calls.health(probe)
        try:
            self.endpoint.parse(call, await self._http.send(self.endpoint.request(call)))
        except (LeagueError, httpx.TransportError):
            return False
        return True

    async def _wait_for_replicas(self, promotion: Promotion, timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while timeout and (outdated := calls.outdated_replicas(await self.league(promotion.league), promotion)):
            if time.monotonic() > deadline:
                raise NotReady(calls.rollout_error(promotion, timeout, outdated))
            await async_sleep(POLL_INTERVAL)
