"""One copy of an environment, whatever its API: actions of the agents that must act in, reports of agents out."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv

from league.errors import EnvironmentMismatch

Observation = dict[str, NDArray]
"""ONNX input name → array without a batch axis."""
Split = Callable[[Any], Observation]
Report = tuple[int, Observation, float, bool, bool]
"""(agent, observation, reward since its last report, terminated, truncated). One without either flag must act."""

MOST_IDLE_STEPS = 10_000
"""Steps in which nobody acts, after which an environment counts as hung."""


class Copy(Protocol):
    """An episode is over when no report of a call asks for an action."""

    def reset(self, seed: int) -> list[Report]:
        """Begin an episode."""
        ...

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        """Act: (agent, action) for each agent that must, in the order of `possible_agents`."""
        ...

    def state(self) -> Any:
        """The environment's own global state as it stands; None where it has none."""
        ...

    def render(self) -> Any:
        """What the environment's own render gives."""
        ...

    def close(self) -> None:
        """Release the environment."""
        ...


def copy_of(env: Any, splits: Sequence[Split]) -> Copy:
    """The adapter for the API of `env`. splits: observation → its named arrays, of each agent."""
    if isinstance(env, AECEnv):
        return AECCopy(env, splits)
    return ParallelCopy(env, splits) if isinstance(env, ParallelEnv) else MultiAgentCopy(env, splits)


class AECCopy:
    """PettingZoo's AEC API: one agent acts at a time. Agents that are done are led out here."""

    def __init__(self, env: AECEnv, splits: Sequence[Split]) -> None:
        self._env, self._splits = env, splits
        self._agents = tuple(env.possible_agents)
        self._index = {agent: index for index, agent in enumerate(self._agents)}

    def reset(self, seed: int) -> list[Report]:
        self._env.reset(seed=seed)
        return self._reports()

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        self._env.step(moves[0][1])
        return self._reports()

    def state(self) -> Any:
        return _state(self._env)

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        self._env.close()

    def _reports(self) -> list[Report]:
        env, reports = self._env, []
        while env.agents:
            agent = self._index[env.agent_selection]
            value, reward, terminated, truncated, _ = env.last()
            observation = self._splits[agent](value)
            if not (terminated or truncated):
                reports.append((agent, observation, float(reward), False, False))
                return reports
            # Copied, since the environment goes on and may write into the arrays that it gave.
            last = {name: np.array(array) for name, array in observation.items()}
            reports.append((agent, last, float(reward), bool(terminated), bool(truncated)))
            env.step(None)
            if self._agents[agent] in env.agents:
                raise EnvironmentMismatch(f"agent {self._agents[agent]} is done, but stays among the agents")
        return reports


class _Simultaneous:
    """Who is in the episode, what each agent is owed, what it saw last, and who has left."""

    def __init__(self, agents: Sequence[str], splits: Sequence[Split]) -> None:
        self._agents, self._splits = tuple(agents), splits
        self._index = {agent: index for index, agent in enumerate(agents)}
        self._present: set[str] = set()
        self._gone: set[str] = set()
        self._owed: dict[str, float] = {}
        self._seen: dict[str, Observation] = {}

    def _begin(self, observations: Mapping[str, Any]) -> list[Report]:
        self._present, self._gone, self._owed, self._seen = set(), set(), dict.fromkeys(self._agents, 0.0), {}
        return self._reports(observations, {}, {}, {})

    def _actions(self, moves: Sequence[tuple[int, Any]]) -> dict[str, Any]:
        return {self._agents[agent]: action for agent, action in moves}

    def _reports(
        self,
        observations: Mapping[str, Any],
        rewards: Mapping[str, float],
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
    ) -> list[Report]:
        owed, present = self._owed, self._present
        for agent, reward in rewards.items():
            if agent in owed and agent not in self._gone:
                owed[agent] += float(reward)
        for agent in observations:
            if agent not in present and not (agent in self._gone and _flag(agent, terminated, truncated)):
                present.add(self._known(agent))
                self._gone.discard(agent)
        reports: list[Report] = []
        for index, agent in enumerate(self._agents):
            if agent not in present:
                continue
            has_left = _flag(agent, terminated, truncated)
            if agent in observations:
                self._seen[agent] = self._splits[index](observations[agent])
            elif not has_left:
                continue
            last = self._seen[agent]
            if has_left:
                last = {name: np.array(array) for name, array in last.items()}
                present.discard(agent)
                self._gone.add(agent)
            flags = bool(terminated.get(agent, False)), bool(truncated.get(agent, False))
            reports.append((index, last, owed[agent], *flags))
            owed[agent] = 0.0
        return reports

    def _known(self, agent: str) -> str:
        if agent not in self._index:
            raise EnvironmentMismatch(
                f"agent {agent!r} has an observation, but is not among possible_agents ({', '.join(self._agents)})"
            )
        return agent


class ParallelCopy(_Simultaneous):
    """PettingZoo's Parallel API: all living agents act at once."""

    def __init__(self, env: ParallelEnv, splits: Sequence[Split]) -> None:
        super().__init__(env.possible_agents, splits)
        self._env = env

    def reset(self, seed: int) -> list[Report]:
        observations, _ = self._env.reset(seed=seed)
        return self._begin(observations)

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        observations, rewards, terminated, truncated, _ = self._env.step(self._actions(moves))
        reports = self._reports(observations, rewards, terminated, truncated)
        if self._present:
            self._check_agents(observations)
        return reports

    def _check_agents(self, observations: Mapping[str, Any]) -> None:
        agents = set(self._env.agents)
        for agent in self._present - agents:
            raise EnvironmentMismatch(f"agent {agent} has left the environment neither terminated nor truncated")
        for agent in agents - observations.keys() - self._gone:
            raise EnvironmentMismatch(f"agent {agent} is among the agents, but has no observation to act on")

    def state(self) -> Any:
        return _state(self._env)

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        self._env.close()


class MultiAgentCopy(_Simultaneous):
    """RLlib's MultiAgentEnv: who has an observation acts; `__all__` ends the episode for everybody who is left."""

    def __init__(self, env: Any, splits: Sequence[Split]) -> None:
        super().__init__(env.possible_agents, splits)
        self._env = env

    def reset(self, seed: int) -> list[Report]:
        observations, self._infos = self._env.reset(seed=seed)
        return self._begin(self._kept(observations)) or self.step(())

    def step(self, moves: Sequence[tuple[int, Any]]) -> list[Report]:
        actions = self._actions(moves)
        ended: list[Report] = []
        for _ in range(MOST_IDLE_STEPS):
            observations, rewards, terminated, truncated, self._infos = self._env.step(actions)
            is_over = terminated.get("__all__", False) or truncated.get("__all__", False)
            if is_over:
                # Who has no flag of its own ends as the episode does.
                left = {*self._present, *observations}
                terminated, truncated = _for_all(left, terminated, truncated)
            reports = ended + self._reports(self._kept(observations), rewards, terminated, truncated)
            is_over = is_over or len(self._gone) == len(self._agents)
            if is_over or any(not (report[3] or report[4]) for report in reports):
                return reports
            actions, ended = {}, reports
        raise EnvironmentMismatch(f"nobody has acted for {MOST_IDLE_STEPS} steps of the environment")

    def state(self) -> Any:
        """RLlib's API has no method for it: `info["state"]` of any agent, or in the common info."""
        told = (info["state"] for info in self._infos.values() if isinstance(info, Mapping) and "state" in info)
        return next(told, _state(self._env))

    def render(self) -> Any:
        return self._env.render()

    def close(self) -> None:
        self._env.close()

    @staticmethod
    def _kept(observations: Mapping[str, Any]) -> dict[str, Any]:
        """Copies, since the last of them may be asked for after the environment has gone on."""
        return {agent: _copied(value) for agent, value in observations.items()}


def _state(env: Any) -> Any:
    try:
        return env.state()
    except (AttributeError, NotImplementedError):
        return None


def _flag(agent: str, terminated: Mapping[str, bool], truncated: Mapping[str, bool]) -> bool:
    return bool(terminated.get(agent, False) or truncated.get(agent, False))


def _for_all(
    agents: Iterable[str], terminated: Mapping[str, bool], truncated: Mapping[str, bool]
) -> tuple[dict[str, bool], dict[str, bool]]:
    """The flags with those of `__all__` for each of `agents` that has none of its own."""
    rest = [agent for agent in agents if not _flag(agent, terminated, truncated)]
    all_terminated = bool(terminated.get("__all__", False))
    return (
        dict(terminated) | dict.fromkeys(rest, all_terminated),
        dict(truncated) | dict.fromkeys(rest, not all_terminated),
    )


def _copied(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copied(part) for key, part in value.items()}
    return np.array(value)
