"""Checks environments (`league check-env`): spaces, seeding, masks, rewards, global state and PettingZoo's API tests.

Episodes are played with random legal actions. A *fault* leads to wrong results or failing runs; a *note* is a warning.
"""

import contextlib
import copy
import io
import math
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium
import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.test import api_test, parallel_api_test

from league.conditions import describe_selection
from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.adapters import EnvAdapter, Observation, Report, adapter_for
from league.environments.building import action_space, build, describe, describe_policies, observation_space
from league.environments.implementation import implementation
from league.environments.vector.equality import compare
from league.environments.vector.measurement import steps_per_second
from league.errors import IllegalMask, LeagueError, one_line
from league.interface import Interface
from league.seeds import derive
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space, inputs
from league.spaces.arrays import check_mask, tensors
from league.spaces.conversion import from_gymnasium


class RandomActions:
    """Samples random legal actions that depend only on the episode's seed and the agent's turns."""

    def __init__(self, spaces: Sequence[gymnasium.Space[Any]]) -> None:
        self._spaces = [copy.deepcopy(space) for space in spaces]

    def seed(self, seed: int) -> None:
        """Start an episode."""
        for agent, space in enumerate(self._spaces):
            space.seed(derive(seed, agent) % 2**31)

    def draw(self, agent: int, mask: NDArray | None) -> Any:
        """Sample a legal action of an agent: an int, or an array in the dtype of its space."""
        space = self._spaces[agent]
        match space:
            case gymnasium.spaces.Discrete():
                return int(space.sample(mask=None if mask is None else (mask != 0).astype(np.int8)))
            case gymnasium.spaces.MultiDiscrete() if mask is not None:
                parts = np.split((mask != 0).astype(np.int8), np.cumsum(space.nvec)[:-1])
                return space.sample(mask=tuple(parts))
        return space.sample()


ENOUGH_TURNS = 20
"""Minimum turns of an agent for the check that its observations change."""
CYCLES = 50
"""Number of cycles of PettingZoo's API tests."""

COMPARED_COPIES, COMPARED_STEPS = 32, 20_000
"""Size of the comparison of a vectorised environment with its stock environment."""
MEASURED_COPIES, MEASURED_SECONDS = 1024, 1.0
"""Copies and duration of the measurement of its speed."""

Severity = Literal["fault", "note"]
Trace = list[tuple[int, bytes, float, bool, bool]]
"""All reports of an episode, in order."""


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem, with the expected behaviour and the affected agents."""

    severity: Severity
    text: str
    agents: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        if not self.agents:
            return self.text
        first, *others = self.agents
        return f"{first}{f' and {len(others)} more' if others else ''}: {self.text}"


@dataclass(frozen=True, slots=True)
class Vectorised:
    """A vectorised environment that reported the same as its stock environment.

    Attributes:
        steps: Environment steps that were compared.
        copies: Number of copies in the measurement of its speed.
        steps_per_second: Environment steps per second of all copies.
        stock_steps_per_second: The same of the stock environment.
    """

    steps: int
    copies: int
    steps_per_second: float
    stock_steps_per_second: float


@dataclass(slots=True)
class Examination:
    """Distinct findings, the lengths of the episodes and the speed."""

    findings: list[Finding] = field(default_factory=list)
    api: str = ""
    agents: int = 0
    lengths: list[int] = field(default_factory=list)
    steps_per_second: float = 0.0
    state_size: int | None = None
    """Size of the global state; None without one."""
    implementation: str = ""
    """How copies of the environment are stepped, and why."""
    policies: str = ""
    """The policies with their agents."""
    actions: str = ""
    """How versions select actions, and why."""
    vectorised: Vectorised | None = None
    """Comparison with the vectorised environment, if there is one."""

    @property
    def passed(self) -> bool:
        """Whether no fault was found."""
        return all(finding.severity == "note" for finding in self.findings)

    def add(self, severity: Severity, text: str, agent: str | None = None) -> None:
        """Add a finding, or an agent to an equal finding."""
        known = next((each for each in self.findings if (each.severity, each.text) == (severity, text)), None)
        if known is None:
            known = Finding(severity, text)
            self.findings.append(known)
        if agent is not None and agent not in known.agents:
            known.agents.append(agent)


def examine(config: LeagueConfig, episodes: int = 3, steps: int = 2000, seed: int = 0) -> Examination:
    """Play episodes of at most `steps` steps, each twice. Never raises exceptions of the environment."""
    found = Examination()
    try:
        found.implementation = implementation(config.environment).reason
        env = build(config.environment)
        interface = describe(env, config)
    except LeagueError as error:
        found.add("fault", str(error))
        return found
    except Exception as error:
        found.add("fault", f"{config.environment.entry_point} cannot be created: {one_line(error, with_type=True)}")
        return found
    found.api = "AEC" if isinstance(env, AECEnv) else "Parallel" if isinstance(env, ParallelEnv) else "MultiAgentEnv"
    found.agents = len(interface.agents)
    found.policies = describe_policies(interface)
    found.actions = describe_selection(config, interface)
    for agent, spaces in interface.agents.items():
        if not _is_supported(spaces.action):
            found.add(
                "fault", "has an unsupported action space: expected Discrete, MultiDiscrete or a Box of floats", agent
            )
    try:
        _play(env, interface, config, found, episodes, steps, seed)
    except LeagueError as error:
        found.add("fault", str(error))
    except Exception as error:
        found.add(
            "fault", f"the environment raised an exception after legal actions: {one_line(error, with_type=True)}"
        )
    finally:
        env.close()
    if found.passed:
        _run_pettingzoo_tests(build(config.environment), found)
    if found.passed:
        _compare_vectorised(config.environment, interface, found, seed)
    return found


def _compare_vectorised(config: EnvironmentConfig, interface: Interface, found: Examination, seed: int) -> None:
    """Compare the vectorised environment, if there is one, with the stock one."""
    vector = implementation(config).vector
    if vector is None:
        return
    try:
        comparison = compare(config, vector(COMPARED_COPIES, **config.kwargs), COMPARED_STEPS, seed)
        if comparison.difference is not None:
            found.add("fault", f"the vectorised environment differs: {comparison.difference}")
            return
        actions = [spaces.action for spaces in interface.agents.values()]
        rate = steps_per_second(vector(MEASURED_COPIES, **config.kwargs), actions, seed, MEASURED_SECONDS)
    except Exception as error:
        found.add("fault", f"the vectorised environment raised an exception: {one_line(error, with_type=True)}")
        return
    found.vectorised = Vectorised(comparison.steps, MEASURED_COPIES, rate, comparison.stock_rate)


def _play(
    env: Any, interface: Interface, config: LeagueConfig, found: Examination, episodes: int, steps: int, seed: int
) -> None:
    checks = [_Check(agent, env, found) for agent in env.possible_agents]
    adapter = adapter_for(env, checks)
    actions = RandomActions([action_space(env, agent) for agent in env.possible_agents])
    began = time.perf_counter()
    first = [_episode(adapter, interface, actions, found, seed + i, steps) for i in range(episodes)]
    found.lengths = [len(trace) for trace in first]
    found.steps_per_second = sum(found.lengths) / (time.perf_counter() - began)
    # After the timing, because a global state may be a large image.
    again = [
        _episode(adapter, interface, actions, found, seed + i, steps, states=True) for i in reversed(range(episodes))
    ][::-1]
    fresh = adapter_for(build(config.environment), checks)
    anew = _episode(fresh, interface, actions, found, seed, steps)
    fresh.close()
    if first != again:
        found.add("fault", "the same seed gives another episode after other episodes: reset must clear all state")
    elif first[0] != anew:
        found.add(
            "fault", "the same seed gives another episode in a new environment: all randomness must depend on the seed"
        )
    _check_constant_observations(first, env, found)
    starts = {trace[0][1] for trace in first if trace}
    if episodes > 1 and len(starts) == 1 and not config.play.opening_plies:
        found.add(
            "note",
            "every seed gives the same first observation: unless later events are random, greedy policies repeat one"
            " game; set play.opening_plies for random openings",
        )


def _episode(
    adapter: EnvAdapter,
    interface: Interface,
    actions: RandomActions,
    found: Examination,
    seed: int,
    steps: int,
    states: bool = False,
) -> Trace:
    """Play an episode with random legal actions. states: check the global state at each step."""
    agents, trace = list(interface.agents), []
    reports = adapter.reset(seed)
    actions.seed(seed)
    for _ in range(steps):
        if states:
            _check_state(adapter, found)
        moves = []
        for agent, observation, reward, terminated, truncated in reports:
            trace.append((agent, _bytes(observation), reward, terminated, truncated))
            _check_report(agents[agent], (agent, observation, reward, terminated, truncated), found)
            if not (terminated or truncated):
                moves.append((agent, actions.draw(agent, observation.get(ACTION_MASK))))
        if not moves:
            return trace
        reports = adapter.step(moves)
    found.add("note", f"an episode did not end within {steps} steps")
    return trace


def _is_supported(space: Space) -> bool:
    """Discrete, MultiDiscrete, or a Box of floats."""
    return isinstance(space, Discrete | MultiDiscrete) or (isinstance(space, Box) and np.dtype(space.dtype).kind == "f")


def _check_constant_observations(traces: list[Trace], env: Any, found: Examination) -> None:
    """Find agents whose observation never changes in the second half of an episode, when frame stacks are full.

    A constant image is a fault; a constant vector is a note, because a game may have a single state.
    """
    for index, agent in enumerate(env.possible_agents):
        seen = [[observation for reporting, observation, *_ in trace if reporting == index] for trace in traces]
        turns = max(map(len, seen))
        if turns < ENOUGH_TURNS or any(len(set(own[len(own) // 2 :])) > 1 for own in seen):
            continue
        space = observation_space(env, agent)
        if isinstance(space, gymnasium.spaces.Box) and len(space.shape) > 1:
            text = (
                f"observes a constant image for {turns} turns; some environments draw only with"
                " `kwargs: {render_mode: rgb_array}`"
            )
            found.add("fault", text, agent)
        else:
            found.add("note", f"observes a constant value in an episode of {turns} turns", agent)


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


class _Check:
    """Splits an agent's observations into arrays, and checks them against its space."""

    def __init__(self, agent: str, env: Any, found: Examination) -> None:
        self._agent, self._found = agent, found
        self._gymnasium = observation_space(env, agent)
        self._space = from_gymnasium(self._gymnasium)
        self._leaves = inputs(self._space)
        self._kept: tuple[Any, Observation] | None = None
        action_space(env, agent)

    def __call__(self, value: Any) -> Observation:
        if self._kept is not None and _changed(*self._kept):
            self._found.add(
                "note", "its observations are modified after they are returned: they are copied", self._agent
            )
        arrays = tensors(self._space, value)
        for name, leaf in self._leaves.items():
            if arrays[name].shape != leaf.shape:
                shape, expected = list(arrays[name].shape), list(leaf.shape)
                self._found.add(
                    "fault", f"observes {name} with shape {shape}, but its space has {expected}", self._agent
                )
        if not self._gymnasium.contains(value):
            self._found.add(
                "note",
                f"observations are not in its space {str(self._gymnasium)[:80]}: the bounds or the dtype differ;"
                " values are cast to the dtype of the space",
                self._agent,
            )
        copies = {name: np.array(array) for name, array in arrays.items()}
        self._kept = (arrays, copies)
        return copies


def _changed(arrays: Observation, copies: Observation) -> bool:
    return any(not np.array_equal(arrays[name], copies[name], equal_nan=True) for name in copies)


def _bytes(observation: Observation) -> bytes:
    return b"".join(np.ascontiguousarray(array).tobytes() for array in observation.values())


def _run_pettingzoo_tests(env: Any, found: Examination) -> None:
    """Run PettingZoo's API tests. They check more than is required here, so failures are notes."""
    try:
        with _silence():
            if isinstance(env, AECEnv):
                api_test(env, num_cycles=CYCLES)
            elif isinstance(env, ParallelEnv):
                parallel_api_test(env, num_cycles=CYCLES)
    except Exception as error:
        found.add("note", f"PettingZoo's API test fails: {one_line(error, with_type=True)}")
    finally:
        env.close()


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield
