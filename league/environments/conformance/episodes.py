"""Episodes with random legal actions, whose reports are checked."""

import math
import time
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from league.config.league import LeagueConfig
from league.environments.adapters import EnvAdapter, Report, adapter_for
from league.environments.building import action_space, build
from league.environments.conformance.findings import Examination, Trace
from league.environments.conformance.observations import ObservationCheck, check_constant_observations
from league.environments.conformance.openings import joined, measure_openings
from league.environments.conformance.random_actions import RandomActions
from league.errors import EnvironmentMismatch, IllegalMask, one_line
from league.interface import Interface
from league.spaces import ACTION_MASK
from league.spaces.arrays import check_mask

MANY_ENDED = 0.05
"""Fraction of openings that end the game above which there is a note."""


@dataclass(slots=True)
class Place:
    """The step that is played, to say where the environment raised an exception."""

    seed: int
    step: int = 0

    def __str__(self) -> str:
        return f"step {self.step} of the episode with seed {self.seed}" if self.step else f"reset with seed {self.seed}"


class Examiner:
    """Plays episodes of one environment and records what is wrong with them."""

    def __init__(self, env: Any, interface: Interface, config: LeagueConfig, found: Examination, steps: int | None):
        """steps: maximum number of steps per episode. None: episodes must end within `play.max_moves` steps."""
        self._env, self._config, self._found = env, config, found
        self._agents = list(interface.agents)
        self._most, self._must_end = (config.play.max_moves, True) if steps is None else (steps, False)
        self._checks = [ObservationCheck(agent, env, found) for agent in env.possible_agents]
        self._spaces = [action_space(env, agent) for agent in env.possible_agents]
        self._actions = RandomActions(self._spaces)
        self.place = Place(0)

    def examine(self, episodes: int, seed: int) -> None:
        """Play episodes, each twice and the first one in a new environment too, and measure random openings.

        Raises what the environment raises; `place` is then where.
        """
        found, adapter = self._found, adapter_for(self._env, self._checks)
        began = time.perf_counter()
        first = [self._episode(adapter, seed + i) for i in range(episodes)]
        found.lengths = [len(trace) for trace in first]
        found.steps_per_second = sum(found.lengths) / (time.perf_counter() - began)
        found.has_common_reward = _has_common_reward(first, len(self._agents))
        # After the timing, because a global state may be a large image.
        again = [self._episode(adapter, seed + i, states=True) for i in reversed(range(episodes))][::-1]
        with closing(adapter_for(build(self._config.environment), self._checks)) as fresh:
            anew = self._episode(fresh, seed)
        if first != again:
            found.add("fault", "the same seed gives another episode after other episodes: reset must clear all state")
        elif first[0] != anew:
            found.add(
                "fault",
                "the same seed gives another episode in a new environment: all randomness must depend on the seed",
            )
        check_constant_observations(first, self._env, found)
        _check_endings(first, found)
        found.openings = measure_openings(adapter, self._spaces, seed)
        _check_openings(self._config.play.opening_plies, found)

    def _episode(self, adapter: EnvAdapter, seed: int, states: bool = False) -> Trace:
        """Play an episode with random legal actions. states: check the global state at each step."""
        trace: Trace = []
        self.place = Place(seed)
        reports = adapter.reset(seed)
        self._actions.seed(seed)
        for step in range(1, self._most + 1):
            self.place.step = step
            if states:
                _check_state(adapter, self._found)
            moves = []
            for agent, observation, reward, terminated, truncated in reports:
                trace.append((agent, joined(observation), reward, terminated, truncated))
                _check_report(self._agents[agent], (agent, observation, reward, terminated, truncated), self._found)
                if not (terminated or truncated):
                    moves.append((agent, self._actions.draw(agent, observation.get(ACTION_MASK))))
            if not moves:
                return trace
            reports = adapter.step(moves)
        if self._must_end:
            raise EnvironmentMismatch(
                f"the episode with seed {seed} did not end within {self._most:,} steps (play.max_moves), after which a"
                " match fails: terminate or truncate it in the environment, or raise play.max_moves"
            )
        self._found.add("note", f"an episode did not end within {self._most} steps (--steps)")
        return trace


def _has_common_reward(traces: list[Trace], agents: int) -> bool:
    """Return whether all agents had the same return in each episode, and not always 0."""
    returns = [[0.0] * agents for _ in traces]
    for own, trace in zip(returns, traces, strict=True):
        for agent, _, reward, *_ in trace:
            own[agent] += reward
    alike = all(math.isclose(value, own[0], rel_tol=1e-6) for own in returns for value in own)
    return agents > 1 and alike and any(own[0] for own in returns)


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
    assert found.openings is not None
    if (best := found.openings.recommended) and not plies:
        found.add("note", f"greedy policies would repeat one game: set play.opening_plies, for example to {best}")
    lengths = found.openings.lengths
    if 0 < plies <= len(lengths) and lengths[plies - 1].ended > MANY_ENDED:
        found.add("note", f"play.opening_plies: {plies} is long for this game. {found.openings.effect(plies)}")


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
