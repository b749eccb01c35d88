"""Steps games that run in simulators: episodes advance as their simulators report, each at its own pace."""

import logging
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from queue import Empty
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from league.config.external import ExternalConfig
from league.environments.external.advertisement import Advertisement, Needs
from league.environments.external.gateway import Arrival, GatewayServer, SimulatorLink
from league.environments.external.messages import (
    MAX_EPISODE,
    Abandoned,
    Hello,
    MessageCodec,
    Reports,
    abandon,
    play,
)
from league.environments.stepping import (
    BatchedEnvironment,
    Indices,
    NextEpisodes,
    Turn,
    check_actions,
    no_envs,
)
from league.environments.vector.vector_env import AgentRows
from league.errors import EnvironmentMismatch, GameCrashed, InvalidInput, LeagueError
from league.interface import AgentInterface
from league.registry.gateways import ForSimulators
from league.registry.storage.rows import Gateway

logger = logging.getLogger(__name__)

LINGER = 0.001
"""Seconds to wait for simulators that answer as fast, so that their reports share a forward pass."""
POLL = 0.5
"""Seconds between two looks at simulators that do not answer, and at interrupts."""
MOST_LOSSES = 20
"""Consecutive episodes of one environment that simulators may lose or abandon."""
ALONE = 3.0
"""Seconds without a simulator after which a warning says where to connect one."""
NO_ENV = NO_EPISODE = -1


Waiting = list[tuple[Indices, AgentRows]]
"""(episodes, rows) of each message and layout."""


class ExternalStepping(BatchedEnvironment):
    """Implements BatchedEnvironment by simulators that connect to a gateway.

    A turn contains the agents that have reported: those of slow simulators come in later turns. Episodes wait until a
    simulator is free. What is in progress when a connection ends is lost, and reported in `Turn.crashed`; the next
    episodes of these environments start with the following step. In training, a turn is empty while no simulator is
    connected, so that a run can end.
    """

    def __init__(
        self,
        config: ExternalConfig,
        agents: Mapping[str, AgentInterface],
        num_envs: int,
        simulators: ForSimulators,
    ) -> None:
        """Open the gateway, and announce it in the registry while episodes are needed. agents: their spaces."""
        super().__init__(tuple(agents), num_envs)
        self._config, self._league = config, simulators.league
        self._is_training = simulators.purpose == "training"
        self._alone_since = perf_counter()
        self._next_check = 0.0
        self._codec = MessageCodec(agents)
        self._newest = 0
        self._links: dict[int, SimulatorLink] = {}
        self._lost: list[int] = []
        self._clear()
        self._gateway = GatewayServer(self._config, self._codec, simulators.league)
        for_registry = Gateway(self._gateway.url, self._gateway.token, simulators.league, simulators.purpose)
        try:
            self._advertisement = Advertisement(
                simulators.storage, for_registry, self._needs, self._gateway.dismiss_all
            )
        except LeagueError:
            self._gateway.close()
            raise

    def _clear(self) -> None:
        shape = self.num_envs, len(self.agents)
        # Of each environment: its episode, the simulator that plays it, since when this one is to report.
        self._episodes = np.full(self.num_envs, NO_EPISODE)
        self._link_of = np.zeros(self.num_envs, np.int64)
        self._waiting_since = np.full(self.num_envs, np.inf)
        self._has_acted = np.zeros(self.num_envs, bool)
        self._losses = np.zeros(self.num_envs, np.int64)
        # Of each agent: whether it must act, has reported and not left, has left.
        self._must_act, self._is_present, self._has_left = (np.zeros(shape, bool) for _ in range(3))
        self._is_shown = np.zeros(self.num_envs, bool)
        self._env_of: dict[int, int] = {}
        self._queue: deque[int] = deque()
        self._acting: Waiting = []
        self._ended: Waiting = []
        self._finished: list[int] = []

    def start(self, next_episodes: NextEpisodes) -> Turn:
        self._release(np.arange(self.num_envs))
        self._next_episodes = next_episodes
        self._abandoned, self._lost = no_envs(), []
        self._clear()
        self._begin(np.arange(self.num_envs))
        return self._turn()

    def step(self, actions: Mapping[int, NDArray]) -> Turn:
        for group, batch in self._pending.items():
            layout = self._codec.layout_of[batch.agents[0]]
            check_actions(batch, actions[group], self._codec.layouts[layout].action, self.agents)
        self._send(actions)
        self._release(self._abandoned)
        free = np.union1d(np.array(self._lost, np.int64), self._abandoned)
        self._abandoned, self._lost = no_envs(), []
        if len(free):
            self._begin(free)
        return self._turn()

    @property
    def busy(self) -> Indices:
        return np.flatnonzero(np.isfinite(self._waiting_since))

    def seconds(self) -> NDArray[np.float64]:
        waiting = perf_counter() - self._waiting_since
        return self._seconds + np.where(np.isfinite(waiting), waiting, 0.0)

    def render(self, env: int, agent: str | None = None) -> NDArray:  # noqa: ARG002  the protocol's
        raise EnvironmentMismatch(f"a game of the simulator {self._config.simulator} cannot be rendered here")

    def close(self) -> None:
        self._advertisement.close()
        self._gateway.close()

    def _needs(self) -> Needs:
        return Needs(self._gateway.simulators, len(self._queue), len(self._env_of))

    def _send(self, actions: Mapping[int, NDArray]) -> None:
        """Send the actions to the simulators."""
        messages: list[tuple[SimulatorLink, str | bytes]] = []
        sent_at = perf_counter()
        for group, batch in self._pending.items():
            numbers = self._link_of[batch.envs]
            layout = self._codec.layout_of[batch.agents[0]]
            for number in np.unique(numbers).tolist():
                rows = np.flatnonzero(numbers == number)
                if (link := self._links.get(number)) is None:
                    continue
                envs, agents = batch.envs[rows], batch.agents[rows]
                message = self._codec.actions(
                    layout, self._episodes[envs], agents, actions[group][rows], link.hello.binary
                )
                messages.append((link, message))
                self._must_act[envs, agents] = False
                self._has_acted[envs] = True
                # A simulator is to report once all agents that must act have acted.
                waits = envs[~self._must_act[envs].any(axis=1)]
                self._waiting_since[waits] = sent_at
        self._gateway.send(messages)

    def _begin(self, free: Indices) -> None:
        """Let the next episodes of free environments wait for simulators."""
        for env in self._starts(free).tolist():
            self._enqueue(env)
        self._hand_out()

    def _enqueue(self, env: int) -> None:
        self._newest += 1
        if self._newest > MAX_EPISODE:
            raise GameCrashed(f"simulators have played {MAX_EPISODE} episodes, as many as have numbers: start again")
        self._episodes[env] = self._newest
        self._env_of[self._newest] = env
        self._queue.append(env)

    def _hand_out(self) -> None:
        """Give waiting episodes to simulators that can play more, in turn."""
        starts: dict[int, list[int]] = defaultdict(list)
        while self._queue and (free := [link for link in self._links.values() if link.has_room]):
            for link in free[: len(self._queue)]:
                env = self._queue.popleft()
                link.playing.add(env)
                self._link_of[env] = link.number
                starts[link.number].append(env)
        sent_at = perf_counter()
        for number, envs in starts.items():
            self._waiting_since[envs] = sent_at
            self._gateway.send([(self._links[number], play(self._episodes[envs].tolist(), self._seeds[envs].tolist()))])

    def _turn(self) -> Turn:
        """Wait until agents must act, or all environments are idle; in training for POLL if there is no simulator."""
        first: float | None = None
        while True:
            timeout = POLL
            if self._acting or self._lost:
                first = perf_counter() if first is None else first
                timeout = first + LINGER - perf_counter() if self._answers_soon() else 0.0
            elif (self._episodes != NO_EPISODE).any():
                first = None
            else:
                break
            if perf_counter() > self._next_check:
                self._next_check = perf_counter() + POLL
                self._check_links()
            try:
                arrival = self._gateway.arrivals.get(timeout > 0, max(timeout, 0.0) or None)
            except Empty:
                if first is not None or (self._is_training and not self._links):
                    break
            else:
                self._process(arrival)
        return self._collected()

    def _answers_soon(self) -> bool:
        """Whether a simulator is to report that has answered within LINGER before."""
        busy = self.busy
        recent = busy[self._waited()[busy] < 2 * LINGER]
        return any(self._links[number].seconds < LINGER for number in np.unique(self._link_of[recent]).tolist())

    def _check_links(self) -> None:
        """End the connections of simulators that do not answer, and say what is missing."""
        limit = self._config.answer_seconds
        for number in np.unique(self._link_of[self._waited() > limit]).tolist():
            if (link := self._links.get(number)) is not None:
                reason = f"the simulator has not reported for {limit:g} s (environment.external.answer_seconds)"
                self._gateway.dismiss(link, reason)
                self._lose(link, reason)
        if self._links and self._advertisement.should_yield and not any(x.is_leaving for x in self._links.values()):
            # It connects again, to the evaluation that waits for a simulator.
            link = min(self._links.values(), key=lambda link: len(link.playing))
            link.is_leaving = True
            self._dismiss_if_idle(link)
        if self._links or not self._queue:
            self._alone_since = perf_counter()
        elif perf_counter() - self._alone_since > ALONE:
            self._alone_since = np.inf
            logger.warning(
                "Waiting for a simulator of league %s: connect one to the server, or to %s with the key %s",
                self._league,
                self._gateway.url,
                self._gateway.token,
            )

    def _waited(self) -> NDArray[np.float64]:
        """Return for how long each environment has waited for the report of its simulator, (n,)."""
        return np.maximum(perf_counter() - self._waiting_since, 0.0)

    def _dismiss_if_idle(self, link: SimulatorLink) -> None:
        if link.is_leaving and not link.playing:
            self._gateway.dismiss(link, "others need simulators: connect again")

    def _process(self, arrival: Arrival) -> None:
        link = arrival.link
        if isinstance(arrival.message, Hello):
            self._links[link.number] = link
            logger.info("Simulator %d has connected: %d episodes at once", link.number, link.hello.episodes)
        link.backlog -= arrival.size
        if link.number not in self._links:
            return  # refused, while its messages waited
        before = len(self._finished)
        try:
            match arrival.message:
                case Reports() as reports:
                    self._read(link, reports)
                case Abandoned(episodes=episodes):
                    self._give_up(link, episodes)
                case str(reason):
                    self._lose(link, reason)
        except InvalidInput as error:
            self._gateway.refuse(link, error)
            self._lose(link, str(error))
        if finished := self._finished[before:]:
            self._begin(np.unique(finished))
        else:
            self._hand_out()

    def _read(self, link: SimulatorLink, message: Reports) -> None:
        """Add the reports of a message, and the environments whose episodes are over with it. Raises InvalidInput."""
        if link.sent_at:
            link.seconds = max(0.0, perf_counter() - link.sent_at)
        for reports in message.rows:
            self._read_rows(link, reports)
        for episode in dict.fromkeys(message.over):
            if (env := self._env(link, episode)) != NO_ENV:
                self._finish(link, env)

    def _env(self, link: SimulatorLink, episode: int) -> int:
        """Return the environment of a simulator's episode; NO_ENV if it has ended, since reports about abandoned ones
        may be under way. Raises InvalidInput.
        """
        env = self._env_of.get(episode)
        if env is None and episode <= self._newest:
            return NO_ENV
        if env is None or self._link_of[env] != link.number:
            raise InvalidInput(f"episode {episode} is not one of this simulator")
        return env

    def _read_rows(self, link: SimulatorLink, reports: AgentRows) -> None:
        envs_of_rows = np.array([self._env(link, episode) for episode in reports.envs.tolist()], np.int64)
        order = np.lexsort((reports.agents, envs_of_rows))
        order = order[envs_of_rows[order] != NO_ENV]
        if not len(order):
            return
        rows, episodes = replace(reports, envs=envs_of_rows).take(order), reports.envs.take(order)
        envs, agents = rows.envs, rows.agents
        slots = envs * len(self.agents) + agents
        twice = self._must_act[envs, agents]
        if twice.any() or len(np.unique(slots)) < len(slots):
            row = int(np.argmax(twice)) if twice.any() else int(np.argmax(np.bincount(slots)[slots] > 1))
            raise InvalidInput(f"{self._described(rows, row)} reports twice before its action")
        if (left := self._has_left[envs, agents]).any():
            raise InvalidInput(f"{self._described(rows, int(np.argmax(left)))} reports after it has left")
        acts = ~rows.has_ended
        # The reward of one that leaves at the start could be counted for the episode before.
        if (early := ~acts & ~self._has_acted[envs]).any():
            raise InvalidInput(f"{self._described(rows, int(np.argmax(early)))} leaves before anybody has acted")
        for waiting, indices in ((self._acting, np.flatnonzero(acts)), (self._ended, np.flatnonzero(~acts))):
            if len(indices):
                part = rows if len(indices) == len(episodes) else rows.take(indices)
                waiting.append((episodes.take(indices), part))
        self._must_act[envs, agents] = self._is_present[envs, agents] = acts
        self._has_left[envs, agents] = ~acts
        reported = envs[np.isfinite(self._waiting_since[envs])]
        if len(reported):
            reported = np.unique(reported)
            self._seconds[reported] += perf_counter() - self._waiting_since[reported]
            self._waiting_since[reported] = np.inf

    def _described(self, rows: AgentRows, row: int) -> str:
        return f"agent {self.agents[rows.agents[row]]} of episode {self._episodes[rows.envs[row]]}"

    def _finish(self, link: SimulatorLink, env: int) -> None:
        episode = self._episodes[env]
        if not self._has_acted[env]:
            raise InvalidInput(f"episode {episode} is over without an action, expected at least one")
        if self._must_act[env].any() or self._is_present[env].any():
            agent = self.agents[int(np.argmax(self._is_present[env]))]
            raise InvalidInput(
                f"episode {episode} is over, but agent {agent} has no last report: expected one with terminated or"
                " truncated"
            )
        self._finished.append(env)
        self._losses[env] = link.abandoned = 0
        self._free(link, env)

    def _free(self, link: SimulatorLink, env: int) -> None:
        """An environment has no episode any more."""
        del self._env_of[int(self._episodes[env])]
        link.playing.discard(env)
        self._episodes[env], self._link_of[env], self._waiting_since[env] = NO_EPISODE, 0, np.inf
        self._must_act[env] = self._is_present[env] = self._has_left[env] = False
        self._has_acted[env] = self._is_shown[env] = False
        self._dismiss_if_idle(link)

    def _release(self, envs: Indices) -> None:
        """Tell simulators to abandon the episodes of some environments."""
        by_link: dict[int, list[int]] = defaultdict(list)
        for env in envs[self._episodes[envs] != NO_EPISODE].tolist():
            episode = int(self._episodes[env])
            if (link := self._links.get(int(self._link_of[env]))) is None:
                self._queue.remove(env)
                del self._env_of[episode]
                self._episodes[env] = NO_EPISODE
            else:
                by_link[link.number].append(episode)
                self._free(link, env)
                self._drop_rows(episode)
        self._gateway.send([(self._links[number], abandon(episodes)) for number, episodes in by_link.items()])

    def _give_up(self, link: SimulatorLink, episodes: Sequence[int]) -> None:
        """A simulator cannot finish episodes. Raises InvalidInput if it finishes hardly any."""
        for episode in episodes:
            if (env := self._env(link, episode)) != NO_ENV:
                link.abandoned += 1
                if link.abandoned > MOST_LOSSES:
                    raise InvalidInput(f"the simulator has abandoned {MOST_LOSSES + 1} consecutive episodes")
                self._lose_episode(link, env, "the simulator abandoned it")

    def _lose(self, link: SimulatorLink, reason: str) -> None:
        """Forget a simulator. Its episodes are lost."""
        del self._links[link.number]
        lost = sorted(link.playing)
        if lost:
            logger.warning("Simulator %d has left with %d episodes: %s", link.number, len(lost), reason)
        for env in lost:
            self._lose_episode(link, env, reason)
        self._hand_out()

    def _lose_episode(self, link: SimulatorLink, env: int, reason: str) -> None:
        """An episode has no end. Raises GameCrashed if it is one too many."""
        episode, is_shown = int(self._episodes[env]), bool(self._is_shown[env])
        self._losses[env] += is_shown
        if self._losses[env] > MOST_LOSSES:
            raise GameCrashed(
                f"{MOST_LOSSES + 1} consecutive episodes of an environment were lost by their simulators, the last one"
                f" with seed {self._seeds[env]}: {reason}"
            )
        self._drop_rows(episode)
        self._free(link, env)
        if is_shown:
            self._lost.append(env)
        else:  # nobody has learned of it: another simulator begins it anew
            self._enqueue(env)

    def _drop_rows(self, episode: int) -> None:
        for waiting in (self._acting, self._ended):
            parts = [(np.flatnonzero(episodes != episode), episodes, rows) for episodes, rows in waiting]
            waiting[:] = [(episodes.take(kept), rows.take(kept)) for kept, episodes, rows in parts if len(kept)]

    def _collected(self) -> Turn:
        acting, ended = (
            AgentRows.of_spaces((rows for _, rows in waiting), self._codec.layout_of)
            for waiting in (self._acting, self._ended)
        )
        for rows in acting:
            self._is_shown[rows.envs] = True
        self._pending = self._batches([rows] for rows in acting)
        turn = Turn(self._pending, ended, _sorted(self._finished), _sorted(self._lost))
        self._acting, self._ended, self._finished = [], [], []
        return turn


def _sorted(envs: Sequence[int]) -> Indices:
    return np.array(sorted(envs), np.int64)
