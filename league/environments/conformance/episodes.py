"""Episodes with random legal actions, whose reports are checked."""

import math
import random
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv

from league.config.league import LeagueConfig
from league.config.network import channels_of
from league.environments.adapters import EnvAdapter, Observation, Report, adapter_for
from league.environments.building import build
from league.environments.conformance.findings import Examination, PlayedEpisode, Trace
from league.environments.conformance.observations import ObservationCheck, check_constant_observations
from league.environments.conformance.openings import joined, measure_openings
from league.environments.conformance.random_actions import RandomActions
from league.environments.conformance.time_budget import TimeBudget
from league.errors import EnvironmentMismatch, IllegalMask, LeagueError, no_exit, one_line, raised_at
from league.interface import Interface
from league.spaces import ACTION_MASK
from league.spaces.arrays import check_mask, mask_size

REPETITIONS = 4
"""Further new environments, for those that draw from a common generator: tosses of a coin are often equal."""
FIRST, RETURNS, OPENINGS = 0.2, 0.7, 0.9
"""Shares of the time after which no further episodes are played: the first ones, which are repeated; those that compare
returns; random openings."""
GAMES, LONGEST_GAME = 20, 100
"""Games of which the returns of agents are compared, and the steps after which they are cut."""
AGREEMENT = 0.75
"""Correlation of the returns of all agents from which they may be one team: in MPE, teams have 0.75 to 1."""


@dataclass(slots=True)
class Place:
    """The step that is played, to say where the environment raised an exception."""

    seed: int
    step: int = 0

    def __str__(self) -> str:
        return f"step {self.step} of the episode with seed {self.seed}" if self.step else f"reset with seed {self.seed}"


class Examiner:
    """Plays episodes of one environment and records what is wrong with them."""

    def __init__(
        self,
        env: Any,
        interface: Interface,
        config: LeagueConfig,
        found: Examination,
        steps: int | None,
        budget: TimeBudget,
    ) -> None:
        """steps: maximum number of steps per episode. None: episodes must end within `play.max_moves` steps."""
        self._env, self._config, self._found, self._budget = env, config, found, budget
        self._agents, self._sides = list(interface.agents), interface.sides
        self._most, self._must_end = (config.play.max_moves, True) if steps is None else (steps, False)
        normalizes = config.training.normalize_observations
        self._checks = [ObservationCheck(agent, env, found, normalizes) for agent in env.possible_agents]
        self._spaces = [interface.agents[agent].action for agent in env.possible_agents]
        self._actions = RandomActions(self._spaces)
        self.place = Place(0)

    def examine(self, episodes: int, seed: int) -> None:
        """Play episodes, each twice and the first one in a new environment too, and measure random openings.

        Raises what the environment raises; `place` is then where.
        """
        examination, adapter, budget = self._found, adapter_for(self._env, self._checks), self._budget
        began = time.perf_counter()
        first: list[PlayedEpisode] = []
        while len(first) < episodes and not (first and budget.is_spent(FIRST)):
            first.append(self._first_episode(adapter, seed + len(first), f"episode {len(first) + 1} of {episodes}"))
        examination.lengths = [episode.steps for episode in first]
        examination.steps_per_second = sum(examination.lengths) / (time.perf_counter() - began)
        is_whole = all(episode.is_whole for episode in first)
        examination.actions_per_episode = max(episode.actions for episode in first) if is_whole else None
        if budget.is_spent(FIRST) and (len(first) < episodes or not is_whole):
            cut = "" if is_whole else f", the last one only to step {first[-1].steps}"
            budget.skipped.append(f"{len(first)} of {episodes} episodes were played{cut}")
        self._check_seeding(adapter, first, seed)
        self._check_thread(first[0], seed)
        traces = [episode.trace for episode in first]
        check_constant_observations(traces, self._env, examination)
        if is_whole:
            _check_endings(traces, examination)
        self._check_returns(adapter, first, seed + episodes)
        examination.openings = measure_openings(adapter, self._spaces, seed, budget, OPENINGS)
        if examination.openings is None:
            budget.skipped.append("random openings were not measured")
        _check_openings(self._config.play.opening_plies, examination)

    def _first_episode(self, adapter: EnvAdapter, seed: int, doing: str) -> PlayedEpisode:
        episode = self._episode(adapter, seed, doing, self._most, share=FIRST)
        if episode.steps < self._most or episode.is_whole:
            return episode
        if self._must_end:
            raise EnvironmentMismatch(
                f"the episode with seed {seed} did not end within {self._most:,} steps (play.max_moves), after which a"
                " match fails: terminate or truncate it in the environment, or raise play.max_moves"
            )
        self._found.add("note", f"an episode did not end within {self._most} steps (--steps)")
        return episode

    def _check_seeding(self, adapter: EnvAdapter, first: list[PlayedEpisode], seed: int) -> None:
        """Play the same episodes again, in reverse order, and the first one in new environments."""
        # After the timing, because a global state may be a large image.
        again = [
            self._episode(adapter, seed + i, "the same episodes again", first[i].steps, states=True)
            for i in reversed(range(len(first)))
        ][::-1]
        before = _global_generators()
        anew = self._anew(first[0], seed)
        drawn = [name for name, state in _global_generators().items() if state != before[name]]
        more: list[PlayedEpisode] = []
        while drawn and len(more) < REPETITIONS and not self._budget.is_spent(FIRST):
            more.append(self._anew(first[0], seed))
        pairs = [*zip(first, again, strict=True), *((first[0], episode) for episode in (anew, *more))]
        change = next((change for one, other in pairs if (change := self._change(one, other))), None)
        if change is None:
            return
        if not any(self._change(episode, anew) for episode in more or [self._anew(first[0], seed)]):
            text = "the same seed gives another episode after other episodes: reset must clear all state"
        else:
            text = (
                "the same seed gives another episode in each new environment: all randomness must follow the seed of"
                " reset"
            ) + "".join(f", and it draws from the generator of the module {name}" for name in drawn)
        self._found.add("fault", text, example=change)

    def _anew(self, episode: PlayedEpisode, seed: int, share: float | None = None) -> PlayedEpisode:
        """Play an episode in a new environment. share: see `_episode`."""
        with closing(adapter_for(build(self._config.environment), self._checks)) as fresh:
            return self._episode(fresh, seed, "the first episode in a new environment", episode.steps, share)

    def _check_thread(self, episode: PlayedEpisode, seed: int) -> None:
        """Play an episode, which a new environment has played here, outside of the main thread, as training does."""
        outcome: Future[PlayedEpisode] = Future()

        def play() -> None:
            try:
                outcome.set_result(self._anew(episode, seed, FIRST))
            except BaseException as error:
                outcome.set_exception(error)

        threading.Thread(target=play, name="episode", daemon=True).start()
        try:
            with no_exit:
                outcome.result()
        except Exception as error:
            where = "".join(f"{line}, " for line in [raised_at(error)] if line)
            self._found.add(
                "fault",
                "outside of the main thread, where training plays too, the environment raised an exception"
                f" ({where}{self.place}): {one_line(error, with_type=not isinstance(error, LeagueError))}. Signals, for"
                " example, work only in the main thread: limit times by timeouts of sockets, subprocesses or threads",
            )

    def _change(self, one: PlayedEpisode, other: PlayedEpisode) -> str:
        """Describe the first report that differs between two episodes; empty if they are equal."""
        names = ("agent", "observation", "reward", "termination", "truncation")
        for number, (before, after) in enumerate(zip(one.trace, other.trace, strict=False), start=1):
            for name, value, changed in zip(names, before, after, strict=True):
                if value != changed:
                    return f"the {name} in report {number}, of {self._agents[before[0]]}"
        return "the length of an episode" if len(one.trace) != len(other.trace) else ""

    def _episode(
        self, adapter: EnvAdapter, seed: int, doing: str, most: int, share: float | None = None, states: bool = False
    ) -> PlayedEpisode:
        """Play an episode with random legal actions.

        Args:
            adapter: The environment.
            seed: Seed of the episode.
            doing: What the progress says.
            most: Steps after which the episode is cut.
            share: Share of the time after which it is cut.
            states: Check the global state at each step, and compare the observations of agents.
        """
        trace: Trace = []
        returns, actions, step = [0.0] * len(self._agents), [0] * len(self._agents), 0
        self.place = Place(seed)
        reports = adapter.reset(seed)
        self._actions.seed(seed)
        while True:
            if states:
                _check_state(adapter, self._found)
                self._compare_views(reports)
            moves = []
            for agent, observation, reward, terminated, truncated in reports:
                trace.append((agent, joined(observation), reward, terminated, truncated))
                returns[agent] += reward
                _check_report(self._agents[agent], (agent, observation, reward, terminated, truncated), self._found)
                if not (terminated or truncated):
                    info = adapter.infos.get(self._agents[agent])
                    is_unmasked = ACTION_MASK not in observation and mask_size(self._spaces[agent]) is not None
                    if is_unmasked and isinstance(info, Mapping) and ACTION_MASK in info:
                        # It is not used, because no info had one after the first reset.
                        text = "gets a mask in its info after a step, but no agent gets one after reset: report masks"
                        self._found.add("fault", f"{text} from reset on", self._agents[agent])
                    moves.append((agent, self._actions.draw(agent, observation.get(ACTION_MASK))))
            is_late = share is not None and step > 0 and self._budget.is_spent(share)
            if not moves or step == most or is_late:
                return PlayedEpisode(trace, step, max(actions), tuple(returns), is_whole=not moves)
            for agent, _ in moves:
                actions[agent] += 1
            step += 1
            self.place.step = step
            self._budget.report(f"{doing}, step {step}")
            reports = adapter.step(moves)

    def _compare_views(self, reports: Sequence[Report]) -> None:
        """Find out whether two agents observe different things in one state."""
        if self._found.views_differ:
            return
        if isinstance(self._env, AECEnv):
            with suppress(Exception):  # `observe` of an agent that is not to act is optional
                views = [
                    check.arrays(self._env.observe(agent))
                    for agent, check in zip(self._agents, self._checks, strict=True)
                    if agent in self._env.agents
                ]
                self._found.views_differ = _differ(views)
        else:
            self._found.views_differ = _differ([observation for _, observation, *_ in reports])

    def _check_returns(self, adapter: EnvAdapter, first: list[PlayedEpisode], seed: int) -> None:
        """Find agents whose returns agree, as those of a team do."""
        games = [episode.returns for episode in first if episode.is_whole]
        if not games or len(self._agents) == 1:
            return
        if _agreement(games) != 1.0:
            # Returns of episodes of very different lengths would agree by their lengths.
            games = [episode.returns for episode in first if episode.is_whole and episode.steps <= LONGEST_GAME]
        while len(games) < GAMES and _agreement(games) != 1.0 and not self._budget.is_spent(RETURNS):
            doing = f"returns of game {len(games) + 1} of {GAMES}"
            games.append(self._episode(adapter, seed + len(games), doing, LONGEST_GAME, share=RETURNS).returns)
        agreement = self._found.agreement = _agreement(games)
        if agreement is not None and agreement >= AGREEMENT and len(self._sides) > 1 and self._config.sides is None:
            how = "are equal" if agreement == 1.0 else f"agree (correlation {agreement:.2f} in {len(games)} games)"
            self._found.add(
                "note",
                f'the returns of all agents {how}: are they one team? A team is one side: `sides: {{team: ["*"]}}`',
            )


def _differ(views: Sequence[Observation]) -> bool:
    """Whether two observations differ. Boards show the same in another order: my pieces, then yours."""
    return len({b"".join(_planes(array) for name, array in view.items() if name != ACTION_MASK) for view in views}) > 1


def _planes(array: NDArray[Any]) -> bytes:
    """The values of an array; of a board or an image, its planes in the order of their values."""
    if array.ndim != 3:
        return array.tobytes()
    planes = np.moveaxis(array, 0 if channels_of(array.shape) == "first" else -1, 0)
    return b"".join(sorted(plane.tobytes() for plane in planes))


def _agreement(games: Sequence[Sequence[float]]) -> float | None:
    """Return the smallest correlation between the returns (games, agents) of two agents.

    1 if all agents have equal returns that are not always 0. None if there are too few games, or constant returns.
    """
    if len(games) < 2:
        return None
    returns = np.array(games)
    if np.allclose(returns, returns[:, :1], rtol=1e-6) and returns.any():
        return 1.0
    if len(games) < GAMES or not returns.std(axis=0).all():
        return None
    return min(float(np.corrcoef(returns.T).min()), 0.999)


def _global_generators() -> dict[str, object]:
    """The states of the generators that all code shares, by module."""
    legacy: Any = np.random.get_state()
    return {"random": random.getstate(), "numpy.random": (legacy[1].tobytes(), legacy[2])}


def _check_endings(traces: list[Trace], found: Examination) -> None:
    """Find games without rewards and without endings, which are known faults of Shimmy's OpenSpiel environments.

    A limit of steps truncates all episodes at the same length, and rewards can be rare: this is no fault.
    """
    has_rewards = any(reward for trace in traces for _, _, reward, *_ in trace)
    ends = [(terminated, truncated) for trace in traces for *_, terminated, truncated in trace]
    all_truncated = any(truncated for _, truncated in ends) and not any(terminated for terminated, _ in ends)
    if all_truncated and not has_rewards and len({len(trace) for trace in traces}) > 1:
        found.add(
            "fault",
            "all episodes were truncated and all rewards were 0: the environment does not report how its games end"
            " (games of OpenSpiel: use `entry_point: openspiel` instead of Shimmy)",
        )
    elif not has_rewards:
        found.add("note", f"all rewards were 0 in {len(traces)} episodes: a policy cannot learn from them")
    elif all_truncated:
        found.add("note", "all episodes were truncated, none was terminated: their last values are bootstrapped")


def _check_openings(plies: int, found: Examination) -> None:
    """Compare `play.opening_plies` with what is recommended."""
    openings = found.openings
    if openings is None:
        return
    if openings.recommended and not plies:
        best = openings.recommended
        found.add("note", f"greedy policies would repeat one game: set play.opening_plies, for example to {best}")
    if not 0 < plies <= len(openings.lengths):
        return
    if warning := openings.warning(plies):
        found.add("note", f"play.opening_plies: {plies} is long for this game. {openings.effect(plies)}. {warning}")
    if openings.lengths[plies - 1].positions <= 1:
        found.add("note", f"play.opening_plies: {plies} does nothing. {openings.effect(plies)}")


def _check_report(agent: str, report: Report, found: Examination) -> None:
    _, observation, reward, terminated, truncated = report
    if not math.isfinite(reward):
        found.add("fault", f"got a reward of {reward}, expected a finite number", agent)
    if terminated and truncated:
        found.add("note", "was both terminated and truncated: treated as terminated", agent)
    if ACTION_MASK in observation and not (terminated or truncated):
        try:
            check_mask(observation[ACTION_MASK][np.newaxis])
        except IllegalMask as error:
            found.add("fault", str(error), agent)
    for name, array in observation.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            found.add("fault", f"observes NaN or infinity in {name}", agent)


def _check_state(adapter: EnvAdapter, found: Examination) -> None:
    """Centralised learners need a global state of a fixed size."""
    try:
        with no_exit:
            raw_state = adapter.state()
        state = None if raw_state is None else np.asarray(raw_state, dtype=np.float32)
    except Exception as error:
        reason = one_line(error, with_type=True)
        found.add("note", f"its global state, which only centralised learners need, cannot be read: {reason}")
        return
    if state is None:
        return
    if found.state_size not in (None, state.size):
        expected = f"{found.state_size}: expected a fixed size"
        found.add("fault", f"its global state has {state.size} numbers, after {expected}")
    if not np.isfinite(state).all():
        found.add("fault", "its global state has NaN or infinity")
    found.state_size = state.size
