"""Environments with one fault or oddity each, of which `check-env` says something."""

import random
import signal
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from league.environments.vector.vector_env import AgentRows
from policy_league.examples.kuhn_poker_vector import KuhnPokerVector
from tests.support.environments.counting import Counting
from tests.support.environments.simultaneous import Simultaneous


class IgnoresSeed(Counting):
    """Its reset ignores the seed: each episode differs from the previous one."""

    played = 0

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        IgnoresSeed.played += 1
        super().reset(IgnoresSeed.played, options)


class Forgetful(Simultaneous):
    """Its first reset has other observations than the later ones."""

    resets = 0

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        self.resets += 1
        return super().reset(min(self.resets, 2), options)


class Shuffled(Simultaneous):
    """It draws from a generator that all code shares. module: `random` or `numpy.random`."""

    def __init__(self, module: str) -> None:
        super().__init__()
        self.draw = random.random if module == "random" else np.random.random

    def _observe(self, agent: str) -> np.ndarray:
        return np.full(3, self.draw(), np.float32)


class WrongShape(Simultaneous):
    def _observe(self, agent: str) -> np.ndarray:
        return np.zeros(4, np.float32)


class OutOfBounds(Simultaneous):
    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 2, (3,), np.float32)


class DictActions(Simultaneous):
    def action_space(self, agent: str) -> spaces.Space:
        return spaces.Dict(move=spaces.Discrete(2), talk=spaces.Discrete(2))


class ConstantImages(Simultaneous):
    """Its images never change."""

    def __init__(self) -> None:
        super().__init__(leaves=(30, 30))

    def observation_space(self, agent: str) -> spaces.Space:
        return spaces.Box(0, 255, (8, 8, 3), np.uint8)

    def _observe(self, agent: str) -> np.ndarray:
        return np.zeros((8, 8, 3), np.uint8)


class OneRound(Simultaneous):
    """Nothing but the time and the seed 0 is observed. rounds: steps of a game."""

    def __init__(self, rounds: int) -> None:
        super().__init__(leaves=(rounds, rounds))

    def reset(self, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        return super().reset(0, options)

    def _observe(self, agent: str) -> np.ndarray:
        return np.array([self.time, self.seed, 0], np.float32)


class Endless(Simultaneous):
    """Its episodes do not end within 10,000 steps."""

    def __init__(self) -> None:
        super().__init__(leaves=(10**9, 10**9))


class Unrewarding(Simultaneous):
    """All rewards are 0. any_length: the seed decides the length of an episode."""

    def __init__(self, truncated: Sequence[int] = (), any_length: bool = False) -> None:
        super().__init__(truncated=truncated)
        self.any_length = any_length

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict, dict]:
        self.leaves = (2 + (seed or 0) % 3,) * 2 if self.any_length else self.leaves
        return super().reset(seed, options)

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        observations, rewards, *flags = super().step(actions)
        return observations, dict.fromkeys(rewards, 0.0), *flags


class Stateful(Counting):
    """Its global state is sound, grows, is not finite, or raises."""

    def __init__(self, kind: str) -> None:
        super().__init__((3, 3))
        self.kind, self.calls = kind, 0

    def state(self) -> Any:
        self.calls += 1
        if self.kind == "raises":
            raise RuntimeError("no camera")
        states = {"grows": np.zeros(self.calls), "nan": np.full((2, 2), np.nan)}
        return states.get(self.kind, np.zeros((2, 3), np.int8))


class Signalling(Simultaneous):
    """Limits the time of its steps by signals, as decorators do."""

    def step(self, actions: dict[str, int]) -> tuple[dict, ...]:
        signal.signal(signal.SIGALRM, signal.getsignal(signal.SIGALRM))
        return super().step(actions)


class WrongKuhnPoker(KuhnPokerVector):
    """Pays the loser."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        return [replace(rows, rewards=-rows.rewards) for rows in super().step(env_ids, actions)]


class BrokenKuhnPoker(KuhnPokerVector):
    """Raises at each step."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray[Any]) -> Sequence[AgentRows]:
        raise ZeroDivisionError("no cards")
