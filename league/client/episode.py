"""Episodes over HTTP: every action of one is the same version's, whatever is promoted meanwhile.

The first reply says which version answers; every later request asks for that one, and brings the recurrent state back.
"""

from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from league.client import calls
from league.client.answers import Answer
from league.client.calls import Call
from league.client.encoding import Encoding
from league.client.models import Model
from league.client.questions import Question
from league.errors import ArtifactCorrupt, UnknownVersion, VersionRetired
from league.seeds import derive

if TYPE_CHECKING:
    from league.client.async_client import AsyncClient
    from league.client.client import Client

GONE = (VersionRetired, UnknownVersion, ArtifactCorrupt)
"""What a server answers when a version that has answered before cannot answer any more."""


class Course:
    """How an episode goes on: its version, its recurrent state, and what its next action is drawn from.

    seed: of the whole episode; step t is drawn from a seed that descends from it and t.
    """

    def __init__(self, model: Model, explore: bool, seed: int | None) -> None:
        self.model = model
        self.explore = explore
        self.seed = seed
        self.last: Answer | None = None
        self.steps = 0

    def next(self, observation: Any, encoding: Encoding, probabilities: bool) -> Call[Answer]:
        """The call for the next action."""
        state = self.last.state if self.last else None
        drawn_from = None if self.seed is None else derive(self.seed, self.steps)
        question = Question.about(
            observation, encoding, explore=self.explore, seed=drawn_from, probabilities=probabilities, state=state
        )
        return calls.act(self.model, question)

    def took(self, answer: Answer) -> Any:
        """Keep what has come, and return its action."""
        self.model = self.model.at(answer.version)
        self.last = answer
        self.steps += 1
        return answer.action


def retired(model: Model, steps: int, error: Exception) -> VersionRetired:
    """What is said when the version that began an episode is gone."""
    return VersionRetired(f"the episode cannot go on after {steps} actions of {model}: {error}")


class _Pinned:
    """What both kinds of episodes tell."""

    def __init__(self, model: Model, explore: bool, seed: int | None) -> None:
        self._course = Course(model, explore, seed)

    @property
    def version(self) -> int | None:
        """The version that answers; None before the first action."""
        return self._course.last.version if self._course.last else None

    @property
    def last(self) -> Answer | None:
        """The last answer, whole: its digest, seed, probabilities; None before the first action."""
        return self._course.last

    @property
    def steps(self) -> int:
        """Actions so far."""
        return self._course.steps


class Episode(_Pinned):
    """One episode of one agent: `client.episode("connect_four")`.

    The version that gives the first action gives all of them. Not for several threads at once.
    """

    def __init__(self, client: "Client", model: Model, *, explore: bool, seed: int | None) -> None:
        super().__init__(model, explore, seed)
        self._client = client

    def act(self, observation: Any, *, probabilities: bool = False) -> Any:
        """The next action, as the environment takes it: an int, or an array.

        Raises what `Client.act` does, and VersionRetired if the version that began the episode is served no more.
        """
        call = self._course.next(observation, self._client.encoding, probabilities)
        try:
            answer = self._client.send(call)
        except GONE as error:
            if self.version is None:
                raise
            raise retired(self._course.model, self.steps, error) from error
        return self._course.took(answer)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The server keeps nothing of an episode: there is nothing to end."""


class AsyncEpisode(_Pinned):
    """One episode of one agent, see `Episode`: `async with client.episode("connect_four") as episode`."""

    def __init__(self, client: "AsyncClient", model: Model, *, explore: bool, seed: int | None) -> None:
        super().__init__(model, explore, seed)
        self._client = client

    async def act(self, observation: Any, *, probabilities: bool = False) -> Any:
        """See `Episode.act`."""
        call = self._course.next(observation, self._client.encoding, probabilities)
        try:
            answer = await self._client.send(call)
        except GONE as error:
            if self.version is None:
                raise
            raise retired(self._course.model, self.steps, error) from error
        return self._course.took(answer)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """The server keeps nothing of an episode: there is nothing to end."""
