"""Adapters that give AEC, Parallel and MultiAgentEnv environments a common interface."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv

from league.errors import InvalidReturn
from league.spaces import Space, paths
from league.spaces.arrays import at_path

Observation = dict[str, NDArray]
"""ONNX input name → array without a batch axis."""
Split = Callable[[Any], Observation]
Report = tuple[int, Observation, float, bool, bool]
"""(agent, observation, reward since the last report, terminated, truncated). Without a flag the agent must act."""

MAX_IDLE_STEPS = 10_000
"""Consecutive steps without an acting agent after which an environment counts as hung."""


RESET, STEP = ("observations", "infos"), ("observations", "rewards", "terminations", "truncations", "infos")
UNFIT = (AttributeError, LookupError, TypeError, ValueError)
"""What a return that does not fit raises here. The environment's own exceptions are not caught."""
LAST = ("observation", "reward", "termination", "truncation", "info")
"""What `reset` and `step` of APIs with simultaneous actions return, and `last` of PettingZoo's AEC API."""


class EnvAdapter(Protocol):
    """An environment with any API. An episode is over when no agent in the reports of a call must act."""

    def reset(self, seed: int) -> list[Report]:
        """Start an episode."""

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        """Step the environment. moves: (agent, action) of each agent that must act, ordered by agent."""

    @property
    def infos(self) -> Mapping[str, Any]:
        """The current infos by agent."""

    def state(self) -> Any:
        """Return the current global state; None if the environment has none."""

    def render(self, agent: str | None) -> Any:
        """Return the result of the environment's `render`, or of its `render_for` for an agent."""

    def close(self) -> None:
        """Close the environment."""


def adapter_for(env: Any, splits: Sequence[Split]) -> EnvAdapter:
    """Return the adapter for the API of `env`. splits: for each agent, a function from observation to named arrays."""
    if isinstance(env, AECEnv):
        return AECAdapter(env, splits)
    return ParallelAdapter(env, splits) if isinstance(env, ParallelEnv) else MultiAgentAdapter(env, splits)


def splitter(space: Space) -> Split:
    """Return a function from observation to named arrays, optimised for common spaces."""
    match list(paths(space).items()):
        case [(name, ())]:
            return lambda value: {name: value}
        case [(first, (key,)), (second, (next_key,))]:
            return lambda value: {first: value[key], second: value[next_key]}
        case leaves:
            return lambda value: {name: at_path(value, path) for name, path in leaves}


class _Adapter:
    """An environment with the indices of its agents."""

    def __init__(self, env: Any, splits: Sequence[Split]) -> None:
        self._env, self._splits = env, splits
        self._agents = tuple(env.possible_agents)
        self._index = {agent: index for index, agent in enumerate(self._agents)}

    def render(self, agent: str | None) -> Any:
        if agent is None:
            return self._env.render()
        agent_id = getattr(self._env, "agent_ids", {}).get(agent, agent)
        return getattr(self._env, "unwrapped", self._env).render_for(agent_id)

    def close(self) -> None:
        self._env.close()

    def _split(self, agent: int, value: Any) -> Observation:
        try:
            return self._splits[agent](value)
        except (LookupError, TypeError) as error:
            raise InvalidReturn(
                f"agent {self._agents[agent]} observes {_shown(value)}: expected the keys of its observation space"
            ) from error


class AECAdapter(_Adapter):
    """PettingZoo's AEC API: one agent acts at a time. Removes finished agents by dead steps."""

    def reset(self, seed: int) -> list[Report]:
        self._env.reset(seed=seed)
        return self._reports()

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        self._env.step(moves[0][1])
        return self._reports()

    @property
    def infos(self) -> Mapping[str, Any]:
        return self._env.infos

    def state(self) -> Any:
        return _state(self._env)

    def _reports(self) -> list[Report]:
        env, reports = self._env, []
        while env.agents:
            agent = self._index[env.agent_selection]
            value, reward, terminated, truncated, _ = self._last()
            observation, reward = self._split(agent, value), _number(env.agent_selection, reward)
            if not (terminated or truncated):
                reports.append((agent, observation, reward, False, False))
                return reports
            # Copied because the environment may reuse the arrays in later steps.
            last = {name: np.array(array) for name, array in observation.items()}
            reports.append((agent, last, reward, bool(terminated), bool(truncated)))
            env.step(None)
            if self._agents[agent] in env.agents:
                raise InvalidReturn(f"agent {self._agents[agent]} is terminated or truncated, but remains in `agents`")
        return reports

    def _last(self) -> Any:
        returned = self._env.last()
        if isinstance(returned, tuple) and len(returned) == len(LAST):
            return returned
        raise InvalidReturn(f"last returned {_counted(returned)}: expected {', '.join(LAST)}")


class _Simultaneous(_Adapter):
    """Common state of APIs with simultaneous actions: present agents, unreported rewards, last observations."""

    def reset(self, seed: int) -> list[Report]:
        returned = self._env.reset(seed=seed)
        self._check("reset", RESET, returned)
        observations, self.infos = returned
        self._present: set[str] = set()
        self._left: set[str] = set()
        self._unreported = dict.fromkeys(self._agents, 0.0)
        self._last_observations: dict[str, Observation] = {}
        return self._reports(observations, {}, {}, {})

    def state(self) -> Any:
        """Return `info["state"]` of any agent or of RLlib's common info, else the environment's `state()`."""
        for info in self.infos.values():
            if isinstance(info, Mapping) and "state" in info:
                return info["state"]
        return _state(self._env)

    def _actions(self, moves: Sequence[tuple[int, Any]]) -> dict[str, Any]:
        return {self._agents[agent]: action for agent, action in moves}

    def _reports(
        self,
        observations: Mapping[str, Any],
        rewards: Mapping[str, float],
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
    ) -> list[Report]:
        if type(self.infos) is not dict and not isinstance(self.infos, Mapping):  # the first condition is faster
            raise TypeError(self.infos)
        unreported, present = self._unreported, self._present
        for agent, reward in rewards.items():
            if agent in unreported and agent not in self._left:
                unreported[agent] += float(reward)
        for agent in observations:
            if agent not in present and not (agent in self._left and _flag(agent, terminated, truncated)):
                present.add(self._known(agent))
                self._left.discard(agent)
        reports: list[Report] = []
        for index, agent in enumerate(self._agents):
            if agent not in present:
                continue
            has_left = _flag(agent, terminated, truncated)
            if agent in observations:
                self._last_observations[agent] = self._splits[index](observations[agent])
            elif not has_left:
                continue
            last = self._last_observations[agent]
            if has_left:
                _check_flags(agent, terminated, truncated)
                last = {name: np.array(array) for name, array in last.items()}
                present.discard(agent)
                self._left.add(agent)
            flags = bool(terminated.get(agent, False)), bool(truncated.get(agent, False))
            reports.append((index, last, unreported[agent], *flags))
            unreported[agent] = 0.0
        return reports

    def _check(self, call: str, names: Sequence[str], returned: Any) -> None:
        """Raise InvalidReturn if `reset` or `step` returned something else than dictionaries by agent that fit."""
        if not isinstance(returned, tuple | list) or len(returned) != len(names):
            dones = " (the former dones are terminations and truncations)" * (call == "step")
            raise InvalidReturn(f"{call} returned {_counted(returned)}: expected {', '.join(names)}{dones}")
        parts = dict(zip(names, returned, strict=True))
        for name, part in parts.items():
            if not isinstance(part, Mapping):
                raise InvalidReturn(f"{call} returned {_shown(part)} as {name}: expected a dictionary by agent")
        for agent, reward in parts.get("rewards", {}).items():
            _number(agent, reward)
        for agent, value in parts["observations"].items():
            self._split(self._index[self._known(agent)], value)

    def _known(self, agent: str) -> str:
        if agent not in self._index:
            raise InvalidReturn(
                f"agent {agent!r} has an observation, but is not in possible_agents ({', '.join(self._agents)})"
            )
        return agent


class ParallelAdapter(_Simultaneous):
    """PettingZoo's Parallel API: all live agents act simultaneously."""

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        returned = self._env.step(self._actions(moves))
        try:
            observations, rewards, terminated, truncated, self.infos = returned
            reports = self._reports(observations, rewards, terminated, truncated)
        except UNFIT:
            self._check("step", STEP, returned)
            raise
        if self._present:
            agents = set(self._env.agents)
            for agent in self._present - agents:
                raise InvalidReturn(
                    f"agent {agent} has left the environment neither terminated nor truncated: both need its key"
                )
            for agent in agents - observations.keys() - self._left:
                raise InvalidReturn(f"agent {agent} is in `agents`, but has no observation")
        return reports


class MultiAgentAdapter(_Simultaneous):
    """RLlib's MultiAgentEnv: agents with an observation act; `__all__` ends the episode for all remaining agents."""

    def reset(self, seed: int) -> list[Report]:
        return super().reset(seed) or self.step(())

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        actions = self._actions(moves)
        ended: list[Report] = []
        for _ in range(MAX_IDLE_STEPS):
            returned = self._env.step(actions)
            try:
                observations, rewards, terminated, truncated, self.infos = returned
                is_over = terminated.get("__all__", False) or truncated.get("__all__", False)
                if is_over:
                    # Agents without their own flag get that of the episode.
                    present = {*self._present, *observations}
                    unflagged = [agent for agent in present if not _flag(agent, terminated, truncated)]
                    all_terminated = bool(terminated.get("__all__", False))
                    terminated = dict(terminated) | dict.fromkeys(unflagged, all_terminated)
                    truncated = dict(truncated) | dict.fromkeys(unflagged, not all_terminated)
                reports = ended + self._reports(observations, rewards, terminated, truncated)
            except UNFIT:
                self._check("step", STEP, returned)
                raise
            is_over = is_over or len(self._left) == len(self._agents)
            if is_over or any(not (report[3] or report[4]) for report in reports):
                return reports
            actions, ended = {}, reports
        raise InvalidReturn(f"no agent had to act for {MAX_IDLE_STEPS} steps")

    def _reports(
        self,
        observations: Mapping[str, Any],
        rewards: Mapping[str, float],
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
    ) -> list[Report]:
        # Copied, because the last observations are used after later steps.
        copies = {agent: _copied(value) for agent, value in observations.items()}
        return super()._reports(copies, rewards, terminated, truncated)


def _state(env: Any) -> Any:
    """`state()` is optional in PettingZoo; elsewhere an attribute with this name may have another meaning."""
    base = getattr(env, "unwrapped", env)
    if getattr(type(base), "state", None) in (AECEnv.state, ParallelEnv.state) or not callable(
        state := getattr(env, "state", None)
    ):
        return None
    try:
        return state()
    except NotImplementedError:
        return None


def _number(agent: str, reward: Any) -> float:
    try:
        return float(reward)
    except (TypeError, ValueError):
        raise InvalidReturn(f"agent {agent} got the reward {_shown(reward)}: expected a number") from None


def _counted(returned: Any) -> str:
    return f"{len(returned)} values" if isinstance(returned, tuple | list) else f"one {type(returned).__name__}"


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    text = text if len(text) <= 60 else f"{text[:59]}…"
    return text if value is None else f"{text} ({type(value).__name__})"


def _flag(agent: str, terminated: Mapping[str, bool], truncated: Mapping[str, bool]) -> bool:
    return bool(terminated.get(agent, False) or truncated.get(agent, False))


def _check_flags(agent: str, *flags: Mapping[str, Any]) -> None:
    """Raise InvalidReturn for lists, which are true whatever they contain."""
    for flag in (values.get(agent, False) for values in flags):
        if not isinstance(flag, bool | int | np.bool_) and np.shape(flag) != ():
            raise InvalidReturn(f"step returned {_shown(flag)} as a flag of {agent}: expected True or False")


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copied(part) for key, part in value.items()}
    return np.array(value)
