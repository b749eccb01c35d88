"""The client of a policy server: actions, episodes, streams, versions and promotions over kept connections."""

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
from league.client.episode import Episode
from league.client.models import parse_model
from league.client.patience import LOOK, Attempts, Outcome
from league.client.questions import BatchQuestion, Question
from league.client.stream import Stream
from league.errors import LeagueError, NotReady
from league.refs import CHAMPION

T = TypeVar("T")


class Client:
    """Calls a policy server. May be used by several threads; close it, or use it as a context.

    url: of the server.
    key: an API key; by default what LEAGUE_API_KEY holds, and none if it is not set.
    caller: who asks, a player or an episode: while a canary is tried, each caller stays with one version; without, the
        champion answers.
    timeout: seconds of one attempt.
    patience: seconds for which an attempt that found no server, or a busy one, is followed by another; 0: never. Every
        call may be repeated: acting changes nothing, and calls that do carry an Idempotency-Key.
    encoding: how arrays are sent, see `league.client.encoding`.

    Every call raises the LeagueError that the server answers, by its code; InvalidInput or InvalidReference for what
    cannot be asked; RemoteError if the server cannot be reached, or fails.
    """

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
        self._http = httpx.Client(limits=LIMITS, verify=self.endpoint.is_encrypted)

    def act(
        self,
        model: str,
        observation: Any,
        *,
        explore: bool = False,
        seed: int | None = None,
        probabilities: bool = False,
        state: str | None = None,
    ) -> Answer:
        """The action of `model` (`connect_four`, `connect_four@3`, `duo.left@champion`) for an observation.

        observation: what the environment gives: an array, a number, nested lists, or a dict of those (`observation`
            and `action_mask`).
        explore: draw the action instead of taking the best; from `seed` if there is one, else from one that the answer
            names.
        probabilities: of all actions, in the answer.
        state: of the answer before, for recurrent policies; None begins an episode. `episode` keeps it for you.
        """
        question = Question.about(
            observation, self.encoding, explore=explore, seed=seed, probabilities=probabilities, state=state
        )
        return self.send(calls.act(parse_model(model), question))

    def act_batch(
        self,
        model: str,
        observations: Any,
        *,
        explore: bool = False,
        seed: int | Sequence[int] | None = None,
        probabilities: bool = False,
        state: Sequence[str | None] | None = None,
    ) -> BatchAnswer:
        """The actions for a batch, of one version.

        observations: a list of them, or arrays whose first axis is the batch. seed: one, or one for each. See `act`.
        """
        question = BatchQuestion.about(
            observations, self.encoding, explore=explore, seed=seed, probabilities=probabilities, state=state
        )
        return self.send(calls.act_batch(parse_model(model), question))

    def episode(self, model: str, *, explore: bool = False, seed: int | None = None) -> Episode:
        """An episode, whose actions are all of the version that gives the first one: see `Episode`."""
        return Episode(self, parse_model(model), explore=explore, seed=seed)

    def stream(self, model: str, *, follow: bool = False) -> Stream:
        """A WebSocket for a client that acts at every tick: see `Stream`."""
        return Stream(self.endpoint, parse_model(model), self.patience, self.encoding, follow=follow)

    def leagues(self) -> list[Document]:
        """All leagues, with their aliases."""
        return self.send(calls.leagues())

    def league(self, league: str) -> Document:
        """A league: aliases, policies with their spaces, and what each replica serves."""
        return self.send(calls.league(league))

    def versions(self, league: str) -> list[Document]:
        """The versions of a league, ascending."""
        return self.send(calls.versions(league))

    def aliases(self, league: str) -> dict[str, int]:
        """Alias → the version that it names."""
        return dict(self.league(league)["aliases"])

    def promote(
        self,
        ref: str,
        *,
        alias: str = CHAMPION,
        expected: int | None = ANY,
        reason: str | None = None,
        idempotency_key: str | None = None,
        wait: float = 0.0,
    ) -> Promotion:
        """Point an alias at a version, `connect_four@3`; needs a key of scope `promote`.

        expected: the version that the alias must name now, None if it must not exist; else AliasMoved is raised.
        idempotency_key: of the call; with the same one it is not applied twice. Made up by default.
        wait: seconds that every replica has to serve it, after which NotReady says which do not; 0: do not wait. Needs
            the scope `read` besides.
        """
        moved = self.send(calls.promote(ref, alias, expected, reason, idempotency_key))
        self._await_followers(moved, wait)
        return moved

    def rollback(
        self, league: str, *, reason: str | None = None, idempotency_key: str | None = None, wait: float = 0.0
    ) -> Promotion:
        """Go back to the champion before; see `promote`."""
        moved = self.send(calls.rollback(league, reason, idempotency_key))
        self._await_followers(moved, wait)
        return moved

    def evaluate(
        self,
        league: str,
        *,
        reason: str | None = None,
        idempotency_key: str | None = None,
        wait: float = 0.0,
        **asked: Any,
    ) -> Document:
        """Start an evaluation; needs a key of scope `evaluate`. Returns it as GET …/evaluations/{evaluation} shows it.

        asked: keys of the body of POST …/evaluations: `contestants=["connect_four@3"], blocks=64`, `kind="nightly"`.
        wait: seconds for its end, whereupon it is returned as it is then; needs the scope `read` besides.
        """
        told = self.send(calls.evaluate(league, asked, reason, idempotency_key))
        deadline = time.monotonic() + wait
        while not calls.has_ended(told) and time.monotonic() < deadline:
            time.sleep(LOOK)
            told = self.evaluation(league, told["evaluation"])
        return told

    def evaluation(self, league: str, number: int) -> Document:
        """An evaluation: how far it is, and its result once it is `done`."""
        return self.send(calls.evaluation(league, number))

    def evaluations(self, league: str, *, before: int | None = None, limit: int = 20) -> list[Document]:
        """A league's evaluations, newest first, without results; those older than number `before`."""
        return self.send(calls.evaluations(league, before, limit))

    def stop_evaluation(self, league: str, number: int) -> Document:
        """Ask for the end of an evaluation, which comes within seconds; what has ended stays as it is."""
        return self.send(calls.stop_evaluation(league, number))

    def is_live(self) -> bool:
        """Whether a replica answers. Asks once."""
        return self._is("live")

    def is_ready(self) -> bool:
        """Whether a replica answers and has loaded what the aliases name. Asks once."""
        return self._is("ready")

    def wait_until_ready(self, timeout: float = 60.0) -> None:
        """Return when a replica is ready. Raises NotReady after `timeout` seconds."""
        deadline = time.monotonic() + timeout
        while not self.is_ready():
            if time.monotonic() > deadline:
                raise NotReady(f"{self.endpoint.url} was not ready within {timeout:g} s")
            time.sleep(LOOK)

    def send(self, call: Call[T]) -> T:
        """Make a call, again and again while there is hope, and return what its reply says."""
        attempts = Attempts(self.patience)
        while True:
            request = self.endpoint.request(call)
            try:
                outcome: Outcome = self._http.send(request)
            except httpx.TransportError as error:
                outcome = error
            pause = attempts.pause(outcome)
            if pause is None:
                return self.endpoint.read(call, outcome)
            time.sleep(pause)

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _is(self, what: str) -> bool:
        call = calls.health(what)
        try:
            self.endpoint.read(call, self._http.send(self.endpoint.request(call)))
        except (LeagueError, httpx.TransportError):
            return False
        return True

    def _await_followers(self, moved: Promotion, timeout: float) -> None:
        deadline = time.monotonic() + timeout
        while timeout and (late := calls.late(self.league(moved.league), moved.alias, moved.version)):
            if time.monotonic() > deadline:
                raise NotReady(calls.not_everywhere(moved, timeout, late))
            time.sleep(LOOK)
