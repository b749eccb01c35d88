"""The contract of batched stepping: n copies in lockstep give each agent what the PettingZoo loop gives it."""

from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from pettingzoo import AECEnv

from league.environments.stepping import BatchedEnvironment, Episode, Turn
from league.seeds import generator
from league.spaces import ACTION_MASK, from_gymnasium, tensors

Report = tuple[str, dict[str, Any], float, bool, bool]
"""(agent, observation, reward, terminated, truncated), in the order of an agent's own turns."""


def draw(seed: int, ply: int, n: int, mask: np.ndarray | None) -> int:
    """A random legal action that depends on the episode and the move alone."""
    legal = np.arange(n) if mask is None else np.flatnonzero(mask)
    return int(generator(seed, ply).choice(legal))


def plain_loop(env: AECEnv, seed: int) -> dict[str, list[Report]]:
    """What PettingZoo's own loop reports to each agent over one episode."""
    reports: dict[str, list[Report]] = defaultdict(list)
    turns: dict[str, int] = defaultdict(int)
    env.reset(seed=seed)
    for agent in env.agent_iter():
        value, reward, terminated, truncated, _ = env.last()
        arrays = tensors(from_gymnasium(env.observation_space(agent)), value)
        copied = {name: np.array(array) for name, array in arrays.items()}
        reports[agent].append((agent, copied, reward, terminated, truncated))
        action = None
        if not (terminated or truncated):
            key = env.possible_agents.index(agent) * 1000 + turns[agent]
            action = draw(seed, key, int(env.action_space(agent).n), copied.get(ACTION_MASK))
            turns[agent] += 1
        env.step(action)
    return reports


def lockstep(
    make: Callable[[int], BatchedEnvironment], env: AECEnv, seeds: list[int], copies: int
) -> dict[int, dict[str, list[Report]]]:
    """What the batched environment reports to each agent of each episode; episodes queue for the copies."""
    batched, queue = make(copies), list(seeds)
    reports: dict[int, dict[str, list[Report]]] = {seed: defaultdict(list) for seed in seeds}
    playing: dict[int, int] = {}

    def next_episode(copy: int) -> Episode | None:
        starting[copy] = queue.pop(0) if queue else None
        seed = starting[copy]
        return None if seed is None else Episode(seed, batched.agents)

    starting: dict[int, int | None] = {}
    turn = batched.start(next_episode)
    while True:
        _read_endings(turn, batched, playing, reports)
        playing.update({copy: seed for copy, seed in starting.items() if seed is not None})
        if not turn.batches:
            return reports
        actions = {}
        for group, batch in turn.batches.items():
            chosen = []
            for row, (copy, index) in enumerate(zip(batch.copies, batch.agents, strict=True)):
                agent = batched.agents[index]
                assert group == agent, "a row is in the batch of another group"
                arrays = {name: array[row] for name, array in batch.observations.items()}
                own = reports[playing[copy]][agent]
                n = int(env.action_space(agent).n)
                chosen.append(draw(playing[copy], index * 1000 + len(own), n, arrays.get(ACTION_MASK)))
                own.append((agent, arrays, batch.rewards[row], False, False))
            actions[group] = np.array(chosen)
        turn = batched.step(actions)


def _read_endings(
    turn: Turn, batched: BatchedEnvironment, playing: dict[int, int], reports: dict[int, dict[str, list[Report]]]
) -> None:
    for ending in turn.endings:
        agent = batched.agents[ending.agent]
        last = (agent, ending.observation, ending.reward, ending.terminated, ending.truncated)
        reports[playing[ending.copy]][agent].append(last)


def assert_stepping_conforms(
    make: Callable[[int], BatchedEnvironment], env: AECEnv, seeds: list[int], copies: int
) -> None:
    """Play `seeds` in `copies` copies at once and one by one in PettingZoo's loop, and compare every report."""
    batched = lockstep(make, env, seeds, copies)
    for seed in seeds:
        alone = plain_loop(env, seed)
        assert set(batched[seed]) == set(alone)
        for agent, expected in alone.items():
            actual = batched[seed][agent]
            assert len(actual) == len(expected), f"{agent} has {len(actual)} reports, expected {len(expected)}"
            for mine, theirs in zip(actual, expected, strict=True):
                assert mine[2:] == theirs[2:]
                for name, array in theirs[1].items():
                    np.testing.assert_array_equal(mine[1][name], array)
                    assert mine[1][name].dtype == array.dtype
