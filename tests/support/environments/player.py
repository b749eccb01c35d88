"""Plays batched environments with everything their protocol allows, by draws of one generator."""

from itertools import count

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch, BatchedEnvironment, Starts, Turn
from league.spaces import ACTION_MASK, Box, Discrete, MultiDiscrete, Space


class Player:
    """Leaves environments idle, abandons episodes, and changes groups. actions: the action space of each agent; by
    default all have at least the actions 0 and 1."""

    def __init__(self, env: BatchedEnvironment, seed: int, actions: list[Space] | None = None) -> None:
        self.env, self.spaces = env, actions or [Discrete(n=2)] * len(env.agents)
        self.rng = np.random.default_rng(seed)
        self.seeds = count()

    def next_episodes(self, envs: NDArray) -> Starts:
        starting = envs[self.rng.random(len(envs)) < 0.9]
        seeds = np.array([next(self.seeds) for _ in starting], np.int64)
        return Starts(starting, seeds, self.groups(len(starting)))

    def groups(self, m: int) -> NDArray:
        """Agents of different spaces are never in one group."""
        return np.arange(len(self.env.agents)) + len(self.env.agents) * self.rng.integers(3, size=(m, 1))

    def start(self) -> Turn:
        self.turn = self.env.start(self.next_episodes)
        return self.turn

    def step(self) -> Turn:
        playing = np.unique(np.concatenate([np.zeros(0, int), *(batch.envs for batch in self.turn.batches.values())]))
        abandoned = playing[self.rng.random(len(playing)) < 0.05]
        actions = {group: self.draws(batch) for group, batch in self.turn.batches.items()}
        kept = {group: batch.without(abandoned) for group, batch in self.turn.batches.items()}
        self.env.abandon(abandoned)
        regrouped = playing[self.rng.random(len(playing)) < 0.2]
        self.env.assign(regrouped, self.groups(len(regrouped)))
        self.actions = {group: actions[group][rows] for group, rows in kept.items()}
        self.turn = self.env.step(self.actions)
        return self.turn

    def draws(self, batch: Batch) -> NDArray:
        space, mask = self.spaces[batch.agents[0]], batch.observations.get(ACTION_MASK)
        match space:
            case MultiDiscrete():
                choices = np.array(space.nvec)
                legal = np.ones((len(batch), choices.sum())) if mask is None else mask
                parts = np.split(self.rng.random(legal.shape) * legal, np.cumsum(choices)[:-1], axis=1)
                return np.stack([part.argmax(axis=1) for part in parts], axis=1)
            case Box():
                return self.rng.uniform(-1, 1, (len(batch), *space.shape)).clip(space.low, space.high)
            case Discrete() if mask is None:
                return self.rng.integers(space.n, size=len(batch)) + space.start
        assert isinstance(space, Discrete)
        return (self.rng.random(mask.shape) * mask).argmax(axis=1) + space.start
