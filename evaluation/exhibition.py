"""One game for people to watch: any policies, near or behind HTTP, one step at a time. Nothing is recorded."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.config import LeagueConfig
from league.environments.lockstep import stepping
from league.environments.stepping import Batch, BatchedEnvironment, Ending, Episode, Turn
from league.errors import UnknownPolicy
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.seeds import generator
from league.spaces import Space, paths


@dataclass(frozen=True, slots=True)
class Move:
    """What an agent saw, and what it did.

    observation: ONNX input name → array, as that agent sees it.
    action: as JSON. dist_inputs: (d,) of the distribution that it is the mode of; None unless a graph was played.
    """

    agent: str
    observation: dict[str, NDArray]
    action: Any
    dist_inputs: NDArray | None = None


@dataclass(frozen=True, slots=True)
class Moment:
    """One step of a game, and what has come of it; the first moment is the beginning, without moves.

    moves: of all that acted in it, in the environment's order of agents.
    endings: of all that it led out of the game. returns: agent → return so far. is_over: whether nobody is left to act,
    or the game was broken off here. acting: who acts next.
    """

    step: int
    moves: tuple[Move, ...]
    endings: tuple[Ending, ...]
    returns: dict[str, float]
    is_over: bool
    acting: tuple[str, ...] = ()


def exhibit(environment: BatchedEnvironment, players: Mapping[str, Policy], seed: int) -> Iterator[Moment]:
    """Play one game on copy 0, agent → policy, and yield it step by step. Checkpoints play greedily.

    The environment is left as the game left it, so that each moment can be rendered. Closing it is the caller's.
    """
    agents = environment.agents
    episodes = iter([Episode(seed, agents)])
    cast = {agent: _Actor(agent, players[agent], seed) for agent in agents}
    returns = dict.fromkeys(agents, 0.0)
    turn, step = environment.start(lambda _: next(episodes, None)), 0
    yield Moment(step, (), tuple(turn.endings), dict(returns), not turn.batches, tuple(turn.batches))
    while turn.batches:
        batches = sorted(turn.batches.items(), key=_place)
        answers = {agent: cast[agent].act(batch) for agent, batch in batches}
        turn = environment.step({agent: actions for agent, (actions, _) in answers.items()})
        step += 1
        for agent, batch in turn.batches.items():
            returns[agent] += batch.rewards[0]
        for ending in turn.endings:
            returns[agents[ending.agent]] += ending.reward
        moves = tuple(move for _, move in answers.values())
        yield Moment(step, moves, tuple(turn.endings), dict(returns), not turn.batches, tuple(turn.batches))


def answer(
    policy: Policy, observations: Arrays, state: Arrays | None, rng: Sequence[np.random.Generator] | None
) -> Actions:
    """What a policy answers greedily, of a graph with the inputs of the distribution that its action is the mode of."""
    if isinstance(policy, OnnxPolicy):
        return policy.distribution(observations, state=state)
    return policy.act(observations, state=state, rng=rng)


def first_observation(config: LeagueConfig, interface: Interface, policy: str | None, seed: int = 0) -> Any:
    """What `policy` (None: whoever begins) sees first in a fresh episode, as nested lists: the body of a request.

    Raises UnknownPolicy if no agent of that policy acts in the first step.
    """
    environment = stepping(config.environment, copies=1)
    try:
        episodes = iter([Episode(seed, environment.agents)])
        turn: Turn = environment.start(lambda _: next(episodes, None))
    finally:
        environment.close()
    for agent, batch in sorted(turn.batches.items(), key=_place):
        if policy in (None, interface.policies[agent]):
            return _value(interface.agents[agent].observation, batch)
    beginning = ", ".join(sorted({repr(interface.policies[agent]) for agent in turn.batches}))
    raise UnknownPolicy(
        f"{policy!r} does not begin an episode of {config.league} ({beginning} does): give an observation"
    )


class _Actor:
    """One agent's policy with what it remembers and draws from."""

    def __init__(self, agent: str, policy: Policy, seed: int) -> None:
        self._agent, self._policy = agent, policy
        self._draws = generator(seed, agent)
        self._state: Arrays | None = None

    def act(self, batch: Batch) -> tuple[NDArray, Move]:
        """The actions (1, …) of a batch of this agent alone, and the move that they are."""
        given = answer(self._policy, batch.observations, self._state, [self._draws])
        self._state, inputs = given.state, given.dist_inputs
        seen = {name: array[0] for name, array in batch.observations.items()}
        move = Move(self._agent, seen, given.actions[0].tolist(), None if inputs is None else inputs[0])
        return given.actions, move


def _place(item: tuple[str, Batch]) -> int:
    return item[1].agents[0]


def _value(space: Space, batch: Batch) -> Any:
    """The first row of a batch as a value of `space`: nested lists, under nested keys."""
    value: Any = {}
    for name, path in paths(space).items():
        part = batch.observations[name][0].tolist()
        if not path:
            return part
        inner = value
        for key in path[:-1]:
            inner = inner.setdefault(key, {})
        inner[path[-1]] = part
    return value
