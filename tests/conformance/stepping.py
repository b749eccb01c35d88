"""The contract of batched stepping: n environments in lockstep give each agent the results of the plain loop of its
API.

Environments are PettingZoo's AEC or Parallel API, or RLlib's MultiAgentEnv. The plain loops follow the documentation of
these APIs and are independent of the stepping.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from pettingzoo import AECEnv, ParallelEnv

from league.environments.apis import RLlibEnv
from league.environments.stepping import BatchedEnvironment, Starts, States, Turn
from league.random.seeds import generator
from league.spaces import ACTION_MASK
from league.spaces.arrays import tensors
from league.spaces.conversion import from_gymnasium

Report = tuple[str, dict[str, Any], float, bool, bool]
"""(agent, observation, reward, terminated, truncated), in the order of the agent's turns."""
Reports = dict[str, list[Report]]


def draw(space: gymnasium.Space, seed: int, agent: int, turn: int, mask: np.ndarray | None) -> Any:
    """A random legal action that depends only on the episode, the agent and its turn."""
    rng = generator(seed, agent, turn)
    if isinstance(space, gymnasium.spaces.Discrete):
        legal = np.arange(space.n) if mask is None else np.flatnonzero(mask)
        return int(rng.choice(legal)) + int(space.start)
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        return rng.integers(space.start, space.start + space.nvec)
    assert isinstance(space, gymnasium.spaces.Box), space
    return rng.uniform(np.maximum(space.low, -2), np.minimum(space.high, 2)).astype(space.dtype)


def plain_loop(env: Any, seed: int) -> Reports:
    """The results of the API's loop for each agent over one episode."""
    reports: Reports = defaultdict(list)
    if isinstance(env, AECEnv):
        _agent_iter(env, seed, reports)
    elif isinstance(env, ParallelEnv):
        _parallel(env, seed, reports)
    else:
        _multi_agent(RLlibEnv(env), seed, reports)
    return reports


def _agent_iter(env: AECEnv, seed: int, reports: Reports) -> None:
    env.reset(seed=seed)
    for agent in env.agent_iter():
        value, reward, terminated, truncated, _ = env.last()
        _report(env, reports, agent, value, reward, terminated, truncated)
        env.step(None if terminated or truncated else _answer(env, seed, agent, reports))


def _parallel(env: ParallelEnv, seed: int, reports: Reports) -> None:
    observations, _ = env.reset(seed=seed)
    for agent, value in observations.items():
        _report(env, reports, agent, value, 0.0, False, False)
    while env.agents:
        actions = {agent: _answer(env, seed, agent, reports) for agent in env.agents}
        observations, rewards, terminated, truncated, _ = env.step(actions)
        for agent, value in observations.items():
            _report(env, reports, agent, value, rewards.get(agent, 0.0), terminated[agent], truncated[agent])


def _multi_agent(env: Any, seed: int, reports: Reports) -> None:
    observations, _ = env.reset(seed=seed)
    pending: dict[str, float] = defaultdict(float)
    alive = set(observations)
    for agent, value in observations.items():
        _report(env, reports, agent, value, 0.0, False, False)
    while True:
        observations, rewards, terminated, truncated, _ = env.step(
            {agent: _answer(env, seed, agent, reports) for agent in observations if agent in alive}
        )
        for agent, reward in rewards.items():
            pending[agent] += reward
        alive |= set(observations)
        everybody = (terminated["__all__"], truncated["__all__"])
        for agent in sorted(alive):
            agent_reports = (terminated.get(agent, False), truncated.get(agent, False))
            flags = agent_reports if any(agent_reports) else everybody
            if agent in observations:
                _report(env, reports, agent, observations[agent], pending.pop(agent, 0.0), *flags)
            elif any(flags):
                last = reports[agent][-1][1]
                reports[agent].append((agent, last, pending.pop(agent, 0.0), *flags))
            if any(flags):
                alive.discard(agent)
        if any(everybody):
            return


def _report(
    env: Any, reports: Reports, agent: str, value: Any, reward: float, terminated: bool, truncated: bool
) -> None:
    arrays = tensors(from_gymnasium(env.observation_space(agent)), value)
    copied = {name: np.array(array) for name, array in arrays.items()}
    reports[agent].append((agent, copied, reward, bool(terminated), bool(truncated)))


def _answer(env: Any, seed: int, agent: str, reports: Reports) -> Any:
    mask = reports[agent][-1][1].get(ACTION_MASK)
    return draw(env.action_space(agent), seed, env.possible_agents.index(agent), len(reports[agent]) - 1, mask)


def lockstep(
    batched: BatchedEnvironment,
    spaces: Mapping[str, gymnasium.Space],
    seeds: list[int],
    steps: int | None = None,
    abandon: Mapping[int, int] | None = None,
) -> dict[int, Reports]:
    """The results of the batched environment for each agent of each episode; episodes are assigned to free
    environments.

    spaces: agent → action space. steps: the number of calls of `step`; None until all episodes are over. abandon: seeds
    of episodes to abandon, and after how many steps.
    """
    left = dict(abandon or {})
    queue = list(seeds)
    reports: dict[int, Reports] = {seed: defaultdict(list) for seed in seeds}
    playing: dict[int, int] = {}
    starting: dict[int, int] = {}

    def next_episodes(envs: np.ndarray) -> Starts:
        return _started(envs, queue, starting, len(batched.agents))

    turn = batched.start(next_episodes)
    steps_taken = 0
    while True:
        _read_endings(turn, batched, playing, reports)
        playing.update(starting)
        starting.clear()
        if not turn.batches or steps_taken == steps:
            return reports
        acting = {env for batch in turn.batches.values() for env in batch.envs.tolist()}
        abandoned = [env for env in acting if left.get(playing[env]) == 0]
        left |= {seed: left[seed] - 1 for seed in map(playing.get, acting) if seed in left}
        if abandoned:
            batched.abandon(np.array(abandoned))
        actions = {}
        for group, batch in turn.batches.items():
            group_actions = []
            assert batch.envs.tolist() == sorted(batch.envs.tolist())
            for row, (env, index) in enumerate(zip(batch.envs.tolist(), batch.agents.tolist(), strict=True)):
                if env in abandoned:
                    continue
                agent = batched.agents[index]
                assert group == index, "a row is in the batch of another group"
                arrays = {name: array[row] for name, array in batch.observations.items()}
                agent_reports = reports[playing[env]][agent]
                group_actions.append(
                    draw(spaces[agent], playing[env], index, len(agent_reports), arrays.get(ACTION_MASK))
                )
                agent_reports.append((agent, arrays, float(batch.rewards[row]), False, False))
            if group_actions:
                actions[group] = np.array(group_actions)
        turn = batched.step(actions)
        steps_taken += 1


def _started(envs: np.ndarray, queue: list[int], starting: dict[int, int], agents: int) -> Starts:
    """The episodes at the head of a queue of seeds, noted in `starting`; each agent is a group."""
    seeds = [queue.pop(0) for _ in envs if queue]
    starting.update(zip(envs.tolist(), seeds, strict=False))
    return Starts(envs[: len(seeds)], np.array(seeds, np.int64), np.tile(np.arange(agents), (len(seeds), 1)))


def _read_endings(
    turn: Turn, batched: BatchedEnvironment, playing: dict[int, int], reports: dict[int, Reports]
) -> None:
    for ending in turn.each_ending():
        agent = batched.agents[ending.agent]
        last = (agent, ending.observation, ending.reward, ending.terminated, ending.truncated)
        reports[playing[ending.env]][agent].append(last)


def assert_stepping_conforms(
    make: Callable[[int], BatchedEnvironment], create: Callable[[], Any], seeds: list[int], num_envs: int
) -> None:
    """Compare episodes in `num_envs` environments with the plain loop of a new `create()` per seed.

    Every other episode is abandoned, each after one more step than the last: its reports until then, and all reports
    of the other episodes, must be unchanged.
    """
    env = create()
    env = env if isinstance(env, AECEnv | ParallelEnv) else RLlibEnv(env)
    spaces = {agent: env.action_space(agent) for agent in env.possible_agents}
    abandoned = {seed: number for number, seed in enumerate(seeds[1::2])}
    episodes = lockstep(make(num_envs), spaces, seeds, abandon=abandoned)
    is_cut = False
    for seed, reports in episodes.items():
        expected = plain_loop(create(), seed)
        if seed in abandoned:
            is_cut |= sum(map(len, reports.values())) < sum(map(len, expected.values()))
            expected = {agent: expected[agent][: len(until_then)] for agent, until_then in reports.items()}
        assert_same_episode(reports, expected)
    assert is_cut, "no episode was abandoned"


def states_of(states: States | None) -> dict[int, np.ndarray]:
    """Environment → its state."""
    return {} if states is None else dict(zip(states.envs.tolist(), states.values, strict=True))


def assert_same_episode(actual: Reports, expected: Reports) -> None:
    """Each agent has the same reports, in the same order, with the same dtypes."""
    assert set(actual) == set(expected)
    for agent, expected_reports in expected.items():
        agent_reports = actual[agent]
        assert len(agent_reports) == len(expected_reports), (
            f"{agent} has {len(agent_reports)} reports, expected {len(expected_reports)}"
        )
        for report, expected_report in zip(agent_reports, expected_reports, strict=True):
            assert report[2:] == expected_report[2:]
            for name, array in expected_report[1].items():
                np.testing.assert_array_equal(report[1][name], array)
                assert report[1][name].dtype == array.dtype
