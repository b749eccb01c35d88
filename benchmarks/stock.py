"""Games of unmodified PettingZoo environments, in PettingZoo's own loops: the peer of several benchmarks."""

from collections.abc import Callable, Iterator
from typing import Any

from league.spaces import ACTION_MASK


def moves(env: Any, act: Callable[[str, Any], Any]) -> Iterator[None]:
    """One game of an AEC environment with masks. Yields after each move. act: agent and observation → action."""
    env.reset()
    for agent in env.agent_iter():
        observation, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        env.step(act(agent, observation))
        yield


def play_game(env: Any, act: Callable[[str, Any], Any]) -> int:
    """Play one game; return the number of moves. act: agent and mask → action."""
    return sum(1 for _ in moves(env, lambda agent, observation: act(agent, observation[ACTION_MASK])))
