"""Episodes over HTTP, in which one version chooses every action.

The first response determines the version. Later requests specify that version and return the recurrent state.
"""

from typing import Any, Protocol, Self, TypeVar

from policy_league_client import calls
from policy_league_client.calls import ApiCall
from policy_league_client.requests import ActionRequest, Encoding
from policy_league_client.responses import VERSION_GONE, ActionResponse, Model, episode_interrupted
from policy_league_client.seeds import derive

T = TypeVar("T")


class AsyncSender(Protocol):
    """The part of `AsyncClient` that an episode uses."""

    encoding: Encoding

    async def send(self, call: ApiCall[T]) -> T:
        """Send an API call and return its parsed response."""


class AsyncEpisode:
    """An episode of one agent, created by `AsyncClient.episode`. Do not share it between threads or tasks.

    The version that answers the first request answers all of them, even if another version is promoted meanwhile.

    Args:
        client: Sends the requests.
        model: The policy, with or without a version.
        explore: See `AsyncClient.act`.
        seed: Seed of the episode. The seed of step t is derived from it and t.
    """

    def __init__(self, client: AsyncSender, model: Model, *, explore: bool | None, seed: int | None) -> None:
        self._client = client
        self._model = model
        self._explore = explore
        self._seed = seed
        self.last: ActionResponse | None = None
        """The last response, with digest, seed and probabilities; None before the first action."""
        self.steps = 0
        """Number of actions so far."""

    @property
    def version(self) -> int | None:
        """The version that answers; None before the first action."""
        return self.last.version if self.last else None

    async def act(
        self,
        observation: Any,
        *,
        probabilities: bool = False,
        deadline_ms: int | None = None,
        analysis: bool = False,
    ) -> Any:
        """Request the next action.

        Args:
            observation: See `AsyncClient.act`.
            probabilities: Include the action probabilities in the response, which is available as `last`.
            deadline_ms: See `AsyncClient.act`.
            analysis: See `AsyncClient.act`. It is in the response, `last`.

        Returns:
            The action in the environment's format: an int or an array (float32 or int64).

        Raises:
            VersionRetired: The version that started the episode is not served any more.
            LeagueError: See `AsyncClient`.
        """
        request = ActionRequest.build(
            observation,
            self._client.encoding,
            explore=self._explore,
            seed=None if self._seed is None else derive(self._seed, self.steps),
            probabilities=probabilities,
            state=self.last.state if self.last else None,
            deadline_ms=deadline_ms,
            analysis=analysis,
        )
        try:
            response = await self._client.send(calls.act(self._model, request))
        except VERSION_GONE as error:
            if self.last is None:
                raise
            raise episode_interrupted(self._model, self.steps, error) from error
        self._model = self._model.at(response.version)
        self.last = response
        self.steps += 1
        return response.action

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        """The server holds no state of an episode, so nothing is released."""
