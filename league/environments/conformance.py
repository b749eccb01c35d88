"""Does an environment keep to the contract that training and matches rely on? `league check-env` asks it here.

Random legal actions are played, and what comes back is held against the spaces, against itself (the same seed must
bring the same episode) and against PettingZoo's own tests. A *fault* makes results wrong or runs fail; a *note* is
worth knowing.
"""

import contextlib
import io
import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium
import numpy as np
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.test import api_test, parallel_api_test

from league.config import LeagueConfig
from league.environments.building import action_space, build, describe, observation_space
from league.environments.copies import Copy, Observation, Report, copy_of
from league.environments.random_actions import RandomActions
from league.errors import IllegalMask, LeagueError
from league.interface import Interface
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space, check_mask, from_gymnasium, inputs, tensors

ENOUGH_TURNS = 20
"""Of an agent, for saying that it always sees the same."""
CYCLES = 50
"""Of PettingZoo's own tests."""

Severity = Literal["fault", "note"]
Trace = list[tuple[int, bytes, float, bool, bool]]
"""Everything that an episode has reported, in order."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is amiss, as a sentence that says what was expected, and the agents that it concerns."""

    severity: Severity
    text: str
    agents: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        if not self.agents:
            return self.text
        first, *others = self.agents
        return f"{first}{f' and {len(others)} more' if others else ''}: {self.text}"


@dataclass(slots=True)
class Examination:
    """What was found, each thing once; how long the episodes were, and how fast."""

    findings: list[Finding] = field(default_factory=list)
    api: str = ""
    agents: int = 0
    lengths: list[int] = field(default_factory=list)
    steps_per_second: float = 0.0
    state_size: int | None = None
    """Numbers of the global state; None where there is none."""

    @property
    def passed(self) -> bool:
        """Whether nothing worse than a note was found."""
        return all(finding.severity == "note" for finding in self.findings)

    def add(self, severity: Severity, text: str, agent: str | None = None) -> None:
        known = next((each for each in self.findings if (each.severity, each.text) == (severity, text)), None)
        if known is None:
            known = Finding(severity, text)
            self.findings.append(known)
        if agent is not None and agent not in known.agents:
            known.agents.append(agent)


def examine(config: LeagueConfig, episodes: int = 3, steps: int = 2000, seed: int = 0) -> Examination:
    """Play `episodes` episodes of at most `steps` steps each, twice. Never raises for what the environment does."""
    found = Examination()
    try:
        env = build(config.environment)
        interface = describe(env, config)
    except LeagueError as error:
        found.add("fault", str(error))
        return found
    except Exception as error:
        found.add("fault", f"{config.environment.entry_point} cannot be made: {_told(error)}")
        return found
    found.api = "AEC" if isinstance(env, AECEnv) else "Parallel" if isinstance(env, ParallelEnv) else "MultiAgentEnv"
    found.agents = len(interface.agents)
    for agent, spaces in interface.agents.items():
        if not _can_be_acted_in(spaces.action):
            found.add("fault", "acts in a space that no policy has: expected Discrete, MultiDiscrete or Box", agent)
    try:
        _play(env, interface, config, found, episodes, steps, seed)
    except LeagueError as error:
        found.add("fault", str(error))
    except Exception as error:
        found.add("fault", f"the environment raised while it was played with legal actions: {_told(error)}")
    finally:
        env.close()
    if found.passed:
        _pettingzoos_own(build(config.environment), found)
    return found


def _play(
    env: Any, interface: Interface, config: LeagueConfig, found: Examination, episodes: int, steps: int, seed: int
) -> None:
    checks = [_Check(agent, env, found) for agent in env.possible_agents]
    copy = copy_of(env, checks)
    actions = RandomActions([action_space(env, agent) for agent in env.possible_agents])
    began = time.perf_counter()
    first = [_episode(copy, interface, actions, found, seed + i, steps) for i in range(episodes)]
    found.lengths = [len(trace) for trace in first]
    found.steps_per_second = sum(found.lengths) / (time.perf_counter() - began)
    # Once the clock has stopped: a global state may be a large picture.
    again = [
        _episode(copy, interface, actions, found, seed + i, steps, states=True) for i in reversed(range(episodes))
    ][::-1]
    fresh = copy_of(build(config.environment), checks)
    anew = _episode(fresh, interface, actions, found, seed, steps)
    fresh.close()
    if first != again:
        found.add("fault", "the same seed brings another episode after others were played: reset must clear everything")
    elif first[0] != anew:
        found.add("fault", "the same seed brings another episode in another copy: all randomness must follow the seed")
    _check_blindness(first, env, found)
    starts = {trace[0][1] for trace in first if trace}
    if episodes > 1 and len(starts) == 1 and not config.play.opening_plies:
        found.add(
            "note",
            "every seed brings the same first observation: if nothing later is random either, greedy policies repeat"
            " one game for ever, unless play.opening_plies makes openings",
        )


def _episode(
    copy: Copy,
    interface: Interface,
    actions: RandomActions,
    found: Examination,
    seed: int,
    steps: int,
    states: bool = False,
) -> Trace:
    """One episode of random legal actions, which follow from the seed and the agents' turns. states: look at the global
    state at each step."""
    agents, trace = list(interface.agents), []
    reports = copy.reset(seed)
    actions.seed(seed)
    for _ in range(steps):
        if states:
            _check_state(copy, found)
        moves = []
        for agent, observation, reward, terminated, truncated in reports:
            trace.append((agent, _bytes(observation), reward, terminated, truncated))
            _check_report(agents[agent], (agent, observation, reward, terminated, truncated), found)
            if not (terminated or truncated):
                moves.append((agent, actions.draw(agent, observation.get(ACTION_MASK))))
        if not moves:
            return trace
        reports = copy.step(moves)
    found.add("note", f"an episode has not ended after {steps} steps")
    return trace


def _can_be_acted_in(space: Space) -> bool:
    """Discrete, MultiDiscrete, or a Box of floats."""
    return isinstance(space, Discrete | MultiDiscrete) or (isinstance(space, Box) and np.dtype(space.dtype).kind == "f")


def _check_blindness(traces: list[Trace], env: Any, found: Examination) -> None:
    """Who sees the same in the second half of each episode, when stacks of frames are full: no picture stays the same,
    but a game of one state may."""
    for index, agent in enumerate(env.possible_agents):
        seen = [[observation for reporting, observation, *_ in trace if reporting == index] for trace in traces]
        turns = max(map(len, seen))
        if turns < ENOUGH_TURNS or any(len(set(own[len(own) // 2 :])) > 1 for own in seen):
            continue
        space = observation_space(env, agent)
        if isinstance(space, gymnasium.spaces.Box) and len(space.shape) > 1:
            text = (
                f"observes the same picture all the time, for {turns} turns: expected one that changes; some"
                " environments draw only with `kwargs: {render_mode: rgb_array}`"
            )
            found.add("fault", text, agent)
        else:
            found.add(
                "note", f"observes the same all through an episode: it cannot tell its {turns} turns apart", agent
            )


def _check_report(agent: str, report: Report, found: Examination) -> None:
    _, observation, reward, terminated, truncated = report
    if not math.isfinite(reward):
        found.add("fault", f"got a reward of {reward}, expected a finite number", agent)
    if terminated and truncated:
        found.add("note", "was terminated and truncated at once: it counts as terminated", agent)
    if ACTION_MASK in observation and not (terminated or truncated):
        try:
            check_mask(observation[ACTION_MASK][np.newaxis])
        except IllegalMask as error:
            found.add("fault", str(error), agent)
    for name, array in observation.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            found.add("fault", f"observes NaN or infinity in {name}", agent)


def _check_state(copy: Copy, found: Examination) -> None:
    """Centralised learners read the global state as one row of numbers, always of one size."""
    try:
        told = copy.state()
        state = None if told is None else np.asarray(told, dtype=np.float32)
    except Exception as error:
        found.add("note", f"its global state cannot be read, which only centralised learners need: {_told(error)}")
        return
    if state is None:
        return
    if found.state_size not in (None, state.size):
        expected = f"{found.state_size}: expected always as many"
        found.add("fault", f"its global state has {state.size} numbers, after {expected}")
    if not np.isfinite(state).all():
        found.add("fault", "its global state has NaN or infinity")
    found.state_size = state.size


class _Check:
    """Splits an agent's observations, and holds them against its space."""

    def __init__(self, agent: str, env: Any, found: Examination) -> None:
        self._agent, self._found = agent, found
        self._gymnasium = observation_space(env, agent)
        self._space = from_gymnasium(self._gymnasium)
        self._leaves = inputs(self._space)
        self._kept: tuple[Any, Observation] | None = None
        action_space(env, agent)

    def __call__(self, value: Any) -> Observation:
        if self._kept is not None and _changed(*self._kept):
            self._found.add("note", "its observations are written over later: they are copied here", self._agent)
        arrays = tensors(self._space, value)
        for name, leaf in self._leaves.items():
            if arrays[name].shape != leaf.shape:
                shape, expected = list(arrays[name].shape), list(leaf.shape)
                self._found.add("fault", f"observes {name} of shape {shape}, its space says {expected}", self._agent)
        if not self._gymnasium.contains(value):
            self._found.add(
                "note",
                f"observes what its space {str(self._gymnasium)[:80]} does not contain: other bounds or another dtype;"
                " values are taken as they are, in the space's dtype",
                self._agent,
            )
        copies = {name: np.array(array) for name, array in arrays.items()}
        self._kept = (arrays, copies)
        return copies


def _changed(arrays: Observation, copies: Observation) -> bool:
    return any(not np.array_equal(arrays[name], copies[name], equal_nan=True) for name in copies)


def _bytes(observation: Observation) -> bytes:
    return b"".join(np.ascontiguousarray(array).tobytes() for array in observation.values())


def _pettingzoos_own(env: Any, found: Examination) -> None:
    """PettingZoo's tests of its API. They guard more than is relied on here, so that a failure is a note."""
    try:
        with _silence():
            if isinstance(env, AECEnv):
                api_test(env, num_cycles=CYCLES)
            elif isinstance(env, ParallelEnv):
                parallel_api_test(env, num_cycles=CYCLES)
    except Exception as error:
        found.add("note", f"PettingZoo's own API test fails: {_told(error)}")
    finally:
        env.close()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def _told(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
