"""PettingZoo AEC environments behind the batched stepping protocol, by a loop over copies."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.config import EnvironmentConfig
from league.environments.building import build
from league.environments.stepping import Batch, Ending, Group, NextEpisode, Turn
from league.errors import IllegalAction
from league.spaces import (
    ACTION_MASK,
    OBSERVATION,
    DictSpace,
    Discrete,
    Space,
    from_gymnasium,
    inputs,
    tensors,
)

Rows = dict[Group, tuple[list[int], list[int], list[dict[str, NDArray]], list[float]]]


class AECStepping:
    """`copies` environments of one configuration, each with its own episode.

    The episodes of a copy are told apart by their seeds alone: nothing of one reaches the next but the environment
    object itself, which PettingZoo's contract requires `reset` to clear.
    """

    def __init__(self, config: EnvironmentConfig, copies: int) -> None:
        self._envs = [build(config) for _ in range(copies)]
        env = self._envs[0]
        self.agents: tuple[str, ...] = tuple(env.possible_agents)
        self._index = {agent: index for index, agent in enumerate(self.agents)}
        spaces = [from_gymnasium(env.observation_space(agent)) for agent in self.agents]
        self._split = [_splitter(space) for space in spaces]
        self._dtypes = [{name: leaf.dtype for name, leaf in inputs(space).items()} for space in spaces]
        self._actions = [from_gymnasium(env.action_space(agent)) for agent in self.agents]
        self._groups: list[Sequence[Group]] = [()] * copies
        self._pending: dict[Group, Batch] = {}
        self._next_episode: NextEpisode = lambda _: None

    @property
    def copies(self) -> int:
        return len(self._envs)

    def start(self, next_episode: NextEpisode) -> Turn:
        self._next_episode = next_episode
        turn = Turn()
        rows: Rows = {}
        for copy in range(self.copies):
            self._restart(copy, turn, rows)
        return self._yield(turn, rows)

    def step(self, actions: Mapping[Group, NDArray]) -> Turn:
        moves: list[tuple[int, Any]] = []
        for group, batch in self._pending.items():
            self._check(batch, actions[group])
            moves += zip(batch.copies, _plain(actions[group]), strict=True)
        turn = Turn()
        rows: Rows = {}
        for copy, action in sorted(moves, key=_copy_of):
            self._envs[copy].step(action)
            self._advance(copy, turn, rows)
        return self._yield(turn, rows)

    def assign(self, copy: int, groups: Sequence[Group]) -> None:
        self._groups[copy] = groups

    def close(self) -> None:
        for env in self._envs:
            env.close()

    def _restart(self, copy: int, turn: Turn, rows: Rows) -> None:
        episode = self._next_episode(copy)
        if episode is None:
            return
        self._groups[copy] = episode.groups
        # PettingZoo environments hand the seed to generators of 32 bits.
        self._envs[copy].reset(seed=episode.seed % 2**32)
        self._advance(copy, turn, rows)

    def _advance(self, copy: int, turn: Turn, rows: Rows) -> None:
        """Report the agent whose turn it is; lead agents that are done out; restart an episode that is over."""
        env = self._envs[copy]
        while env.agents:
            name = env.agent_selection
            agent = self._index[name]
            value, reward, terminated, truncated, _ = env.last()
            observation = self._split[agent](value)
            if not (terminated or truncated):
                group = self._groups[copy][agent]
                if group not in rows:
                    rows[group] = ([], [], [], [])
                copies, agents, observations, rewards = rows[group]
                copies.append(copy)
                agents.append(agent)
                observations.append(observation)
                rewards.append(float(reward))
                return
            # Copied, since the environment goes on and may write into the arrays that it gave.
            last = {key: np.array(array) for key, array in observation.items()}
            turn.endings.append(Ending(copy, agent, last, float(reward), bool(terminated), bool(truncated)))
            env.step(None)
        turn.finished.append(copy)
        self._restart(copy, turn, rows)

    def _yield(self, turn: Turn, rows: Rows) -> Turn:
        for group, (copies, agents, observations, rewards) in rows.items():
            dtypes = self._dtypes[agents[0]]
            stacked = {name: np.array([row[name] for row in observations], dtype=dtypes[name]) for name in dtypes}
            turn.batches[group] = Batch(copies, agents, stacked, rewards)
        self._pending = turn.batches
        return turn

    def _check(self, batch: Batch, actions: NDArray) -> None:
        """Refuse a batch of actions that is not legal, before anything has moved."""
        if len(actions) != len(batch.copies):
            raise IllegalAction(f"{len(actions)} actions for {len(batch.copies)} agents that must act")
        mask = batch.observations.get(ACTION_MASK)
        space = self._actions[batch.agents[0]]
        if not isinstance(space, Discrete):
            return
        chosen = actions - space.start
        legal = (chosen >= 0) & (chosen < space.n)
        if mask is not None:
            legal &= mask[np.arange(len(mask)), np.where(legal, chosen, 0)] != 0
        if not legal.all():
            row = int(np.argmin(legal))
            raise IllegalAction(
                f"action {actions[row]} of {self.agents[batch.agents[row]]} is illegal"
                + ("" if mask is None else f": action_mask is {mask[row].tolist()}")
            )


def _splitter(space: Space) -> Callable[[Any], dict[str, NDArray]]:
    """Observation → its named arrays; the common masked form without the cost of the general one."""
    if isinstance(space, DictSpace) and set(space.spaces) == {OBSERVATION, ACTION_MASK}:
        plain = not any(isinstance(part, DictSpace) for part in space.spaces.values())
        if plain:
            return lambda value: {OBSERVATION: value[OBSERVATION], ACTION_MASK: value[ACTION_MASK]}
    return lambda value: tensors(space, value)


def _plain(actions: NDArray) -> list[Any]:
    """Discrete actions as Python integers, which environments index lists with; arrays as they are."""
    return actions.tolist() if actions.ndim == 1 else list(actions)


def _copy_of(move: tuple[int, Any]) -> int:
    return move[0]
