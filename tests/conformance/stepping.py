"""The contract of batched stepping: n copies in lockstep give each agent what its API's plain loop gives it.

Environments are PettingZoo's AEC or Parallel, or RLlib's MultiAgentEnv. The plain loops are written as their own
documentation writes them, and know nothing of the stepping.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from pettingzoo import AECEnv, ParallelEnv

from league.environments.building import action_space, observation_space
from league.environments.stepping import BatchedEnvironment, Episode, Turn
from league.seeds import generator
from league.spaces import ACTION_MASK, from_gymnasium, tensors

Report = tuple[str, dict[str, Any], float, bool, bool]
"""(agent, observation, reward, terminated, truncated), in the order of an agent's own turns."""
Reports = dict[str, list[Report]]


def draw(space: gymnasium.Space, seed: int, agent: int, turn: int, mask: np.ndarray | None) -> Any:
    """A random legal action that depends on the episode, the agent and its turn alone."""
    rng = generator(seed, agent, turn)
    if isinstance(space, gymnasium.spaces.Discrete):
        legal = np.arange(space.n) if mask is None else np.flatnonzero(mask)
        return int(rng.choice(legal)) + int(space.start)
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        return rng.integers(space.start, space.start + space.nvec)
    assert isinstance(space, gymnasium.spaces.Box), space
    return rng.uniform(np.maximum(space.low, -2), np.minimum(space.high, 2)).astype(space.dtype)


def plain_loop(env: Any, seed: int) -> Reports:
    """What the API's own loop reports to each agent over one episode."""
    reports: Reports = defaultdict(list)
    if isinstance(env, AECEnv):
        _agent_iter(env, seed, reports)
    elif isinstance(env, ParallelEnv):
        _all_at_once(env, seed, reports)
    else:
        _multi_agent(env, seed, reports)
    return reports


def _agent_iter(env: AECEnv, seed: int, reports: Reports) -> None:
    env.reset(seed=seed)
    for agent in env.agent_iter():
        value, reward, terminated, truncated, _ = env.last()
        _report(env, reports, agent, value, reward, terminated, truncated)
        env.step(None if terminated or truncated else _answer(env, seed, agent, reports))


def _all_at_once(env: ParallelEnv, seed: int, reports: Reports) -> None:
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
    owed: dict[str, float] = defaultdict(float)
    living = set(observations)
    for agent, value in observations.items():
        _report(env, reports, agent, value, 0.0, False, False)
    while True:
        observations, rewards, terminated, truncated, _ = env.step(
            {agent: _answer(env, seed, agent, reports) for agent in observations if agent in living}
        )
        for agent, reward in rewards.items():
            owed[agent] += reward
        living |= set(observations)
        everybody = (terminated["__all__"], truncated["__all__"])
        for agent in sorted(living):
            own = (terminated.get(agent, False), truncated.get(agent, False))
            flags = own if any(own) else everybody
            if agent in observations:
                _report(env, reports, agent, observations[agent], owed.pop(agent, 0.0), *flags)
            elif any(flags):
                last = reports[agent][-1][1]
                reports[agent].append((agent, last, owed.pop(agent, 0.0), *flags))
            if any(flags):
                living.discard(agent)
        if any(everybody):
            return


def _report(
    env: Any, reports: Reports, agent: str, value: Any, reward: float, terminated: bool, truncated: bool
) -> None:
    arrays = tensors(from_gymnasium(observation_space(env, agent)), value)
    copied = {name: np.array(array) for name, array in arrays.items()}
    reports[agent].append((agent, copied, reward, bool(terminated), bool(truncated)))


def _answer(env: Any, seed: int, agent: str, reports: Reports) -> Any:
    mask = reports[agent][-1][1].get(ACTION_MASK)
    return draw(action_space(env, agent), seed, env.possible_agents.index(agent), len(reports[agent]) - 1, mask)


def lockstep(
    batched: BatchedEnvironment,
    spaces: Mapping[str, gymnasium.Space],
    seeds: list[int],
    steps: int | None = None,
    broken: Mapping[int, int] | None = None,
) -> dict[int, Reports]:
    """What the batched environment reports to each agent of each episode; episodes queue for the copies.

    spaces: agent → how it acts. steps: calls of `step` after which to stop; None until all episodes are over.
    broken: seeds of episodes that are abandoned, and after how many steps.
    """
    broken, left = broken or {}, dict(broken or {})
    queue = list(seeds)
    reports: dict[int, Reports] = {seed: defaultdict(list) for seed in seeds}
    playing: dict[int, int] = {}
    starting: dict[int, int | None] = {}

    def next_episode(copy: int) -> Episode | None:
        starting[copy] = queue.pop(0) if queue else None
        seed = starting[copy]
        return None if seed is None else Episode(seed, batched.agents)

    turn = batched.start(next_episode)
    taken = 0
    while True:
        _read_endings(turn, batched, playing, reports)
        playing.update({copy: seed for copy, seed in starting.items() if seed is not None})
        starting.clear()
        if not turn.batches or taken == steps:
            return reports
        acting = {copy for batch in turn.batches.values() for copy in batch.copies}
        abandoned = [copy for copy in acting if left.get(playing[copy]) == 0]
        left |= {seed: left[seed] - 1 for seed in map(playing.get, acting) if seed in left}
        if abandoned:
            batched.abandon(abandoned)
        actions = {}
        for group, batch in turn.batches.items():
            chosen = []
            for row, (copy, index) in enumerate(zip(batch.copies, batch.agents, strict=True)):
                if copy in abandoned:
                    continue
                agent = batched.agents[index]
                assert group == agent, "a row is in the batch of another group"
                arrays = {name: array[row] for name, array in batch.observations.items()}
                own = reports[playing[copy]][agent]
                chosen.append(draw(spaces[agent], playing[copy], index, len(own), arrays.get(ACTION_MASK)))
                own.append((agent, arrays, batch.rewards[row], False, False))
            if chosen:
                actions[group] = np.array(chosen)
        turn = batched.step(actions)
        taken += 1


def _read_endings(
    turn: Turn, batched: BatchedEnvironment, playing: dict[int, int], reports: dict[int, Reports]
) -> None:
    for ending in turn.endings:
        agent = batched.agents[ending.agent]
        last = (agent, ending.observation, ending.reward, ending.terminated, ending.truncated)
        reports[playing[ending.copy]][agent].append(last)


def assert_stepping_conforms(
    make: Callable[[int], BatchedEnvironment], stock: Callable[[], Any], seeds: list[int], copies: int
) -> None:
    """Compare every report of `seeds`, played in `copies` copies, with the plain loop of a fresh `stock()` for each."""
    env = stock()
    spaces = {agent: action_space(env, agent) for agent in env.possible_agents}
    batched = lockstep(make(copies), spaces, seeds)
    for seed in seeds:
        assert_same_episode(batched[seed], plain_loop(stock(), seed))


def assert_abandoning_conforms(
    make: Callable[[int], BatchedEnvironment], stock: Callable[[], Any], seeds: list[int], copies: int
) -> None:
    """Every other episode is broken off, after one step more than the one before that: up to there it is reported as
    ever, and of the others nothing changes.
    """
    env = stock()
    spaces = {agent: action_space(env, agent) for agent in env.possible_agents}
    broken = {seed: number for number, seed in enumerate(seeds[::2])}
    reported = lockstep(make(copies), spaces, seeds, broken=broken)
    for seed in seeds:
        expected = plain_loop(stock(), seed)
        if seed in broken:
            expected = {agent: expected[agent][: len(own)] for agent, own in reported[seed].items()}
        assert_same_episode(reported[seed], expected)
    assert any(
        sum(map(len, reported[seed].values())) < sum(map(len, plain_loop(stock(), seed).values())) for seed in broken
    ), "no episode was broken off"


def assert_states_conform(
    make: Callable[[int], BatchedEnvironment], stock: Callable[[], Any], seeds: list[int], copies: int
) -> None:
    """The global states of each episode, its last one included, are those of a fresh `stock()` that is played alike.

    make: an environment that gives states along. Agents act at once, all from the first step to the last.
    """
    env = stock()
    spaces = {agent: action_space(env, agent) for agent in env.possible_agents}
    batched, queue = make(copies), list(seeds)
    playing: dict[int, int] = {}
    starting: dict[int, int] = {}
    found: dict[int, list[np.ndarray]] = defaultdict(list)

    def next_episode(copy: int) -> Episode | None:
        if not queue:
            return None
        starting[copy] = queue.pop(0)
        return Episode(starting[copy], batched.agents)

    turn = batched.start(next_episode)
    while True:
        for copy, state in turn.last_states.items():
            found[playing[copy]].append(state)
        assert set(turn.last_states) == set(turn.finished)
        playing.update(starting)
        starting.clear()
        for copy, state in turn.states.items():
            found[playing[copy]].append(state)
        if not turn.batches:
            break
        turn = batched.step(
            {
                agent: np.array(
                    [
                        draw(spaces[agent], playing[copy], index, len(found[playing[copy]]) - 1, None)
                        for copy, index in zip(batch.copies, batch.agents, strict=True)
                    ]
                )
                for agent, batch in turn.batches.items()
            }
        )
    for seed in seeds:
        expected = plain_states(stock(), spaces, seed)
        assert len(found[seed]) == len(expected)
        for own, theirs in zip(found[seed], expected, strict=True):
            np.testing.assert_array_equal(own, np.asarray(theirs, dtype=np.float32).ravel())


def plain_states(env: Any, spaces: Mapping[str, gymnasium.Space], seed: int) -> list[Any]:
    """What `state()`, or the info of an agent, tells at the reset and behind each step of an episode."""

    def told(infos: Mapping[str, Any]) -> Any:
        return np.array(env.state() if isinstance(env, ParallelEnv) else next(iter(infos.values()))["state"])

    observations, infos = env.reset(seed=seed)
    states = [told(infos)]
    while True:
        actions = {
            agent: draw(spaces[agent], seed, env.possible_agents.index(agent), len(states) - 1, None)
            for agent in observations
        }
        observations, _, terminated, truncated, infos = env.step(actions)
        states.append(told(infos))
        if any(terminated.values()) or any(truncated.values()):
            return states


def assert_same_episode(actual: Reports, expected: Reports) -> None:
    """Each agent has the same reports, in the same order, down to the dtype."""
    assert set(actual) == set(expected)
    for agent, theirs in expected.items():
        own = actual[agent]
        assert len(own) == len(theirs), f"{agent} has {len(own)} reports, expected {len(theirs)}"
        for mine, other in zip(own, theirs, strict=True):
            assert mine[2:] == other[2:]
            for name, array in other[1].items():
                np.testing.assert_array_equal(mine[1][name], array)
                assert mine[1][name].dtype == array.dtype
