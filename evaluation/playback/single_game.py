"""Plays a single unrecorded game step by step, with local or remote policies."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.conditions import ActionSelection
from league.config.league import LeagueConfig
from league.environments.implementation import stock_stepping
from league.environments.stepping import Batch, BatchedEnvironment, Ending, Turn, each_agent_alone
from league.errors import GameCrashed, UnknownPolicy, cause
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, Arrays, Policy
from league.random.seeds import generator
from league.search.searched_actions import SearchedActions
from league.spaces.arrays import nested


@dataclass(frozen=True, slots=True)
class Move:
    """Observation and action of an agent in one step.

    observation: ONNX input name → array. action: as JSON. dist_inputs: (d,) inputs of the action distribution; None
    unless the policy is a graph or searches. value: the return that the agent expects; None unless the policy searches.
    """

    agent: str
    observation: dict[str, NDArray]
    action: Any
    dist_inputs: NDArray | None = None
    value: float | None = None


@dataclass(frozen=True, slots=True)
class GameStep:
    """One step of a game. The first one is the reset, without moves.

    moves: of all agents that acted, in the environment's order. endings: of all agents that left the game.
    returns: agent → return so far. is_over: whether the game has ended. acting: who acts next.
    """

    step: int
    moves: tuple[Move, ...]
    endings: tuple[Ending, ...]
    returns: dict[str, float]
    is_over: bool
    acting: tuple[str, ...] = ()


def play_game(
    environment: BatchedEnvironment, players: Mapping[str, Policy], seed: int, actions: ActionSelection = "greedy"
) -> Iterator[GameStep]:
    """Play one game in environment 0 and yield its steps.

    players: agent → policy. actions: how versions select actions.

    The environment stays as the game left it, so that each step can be rendered. The caller closes it.
    """
    agents = environment.agents
    policies = [_AgentPolicy(agent, players[agent], seed, actions == "sampled") for agent in agents]
    returns = dict.fromkeys(agents, 0.0)
    turn, step = environment.start(each_agent_alone([seed], len(agents))), 0
    yield GameStep(step, (), (), dict(returns), not turn.batches, _acting(turn, agents))
    while turn.batches:
        answers = {agent: policies[agent].act(batch) for agent, batch in turn.batches.items()}
        turn = environment.step({agent: action for agent, (action, _) in answers.items()})
        step += 1
        for agent, batch in turn.batches.items():
            returns[agents[agent]] += float(batch.rewards[0])
        endings = tuple(turn.each_ending())
        for ending in endings:
            returns[agents[ending.agent]] += ending.reward
        moves = tuple(move for _, move in answers.values())
        yield GameStep(step, moves, endings, dict(returns), not turn.batches, _acting(turn, agents))


def policy_output(
    policy: Policy,
    observations: Arrays,
    state: Arrays | None,
    rng: Sequence[np.random.Generator] | None,
    explore: bool = False,
) -> Actions:
    """A policy's output. For a graph, it includes the inputs of the action distribution."""
    if isinstance(policy, OnnxPolicy) and not explore:
        return policy.distribution(observations, state=state)
    return policy.act(observations, state=state, explore=explore, rng=rng)


def expected_return(output: Actions) -> float | None:
    """The return that the agent of a single row expects; None unless the policy searches."""
    return float(output.values[0]) if isinstance(output, SearchedActions) else None


def first_observation(config: LeagueConfig, interface: Interface, policy: str | None, seed: int = 0) -> Any:
    """First observation of `policy` (None: of whoever begins) in a new episode as nested lists, as in a request body.

    Raises UnknownPolicy if no agent of that policy acts in the first step.
    """
    with closing(stock_stepping(config.environment, num_envs=1)) as environment:
        agents = environment.agents
        turn: Turn = environment.start(each_agent_alone([seed], len(agents)))
    for agent, batch in turn.batches.items():
        if policy in (None, interface.policies[agents[agent]]):
            values = {name: array[0].tolist() for name, array in batch.observations.items()}
            return nested(interface.agents[agents[agent]].observation, values)
    beginning = ", ".join(sorted({repr(interface.policies[agent]) for agent in _acting(turn, agents)}))
    raise UnknownPolicy(f"{policy!r} does not act first in {config.league} ({beginning} does): pass an observation")


class _AgentPolicy:
    """Policy of one agent with its recurrent state and random generator."""

    def __init__(self, agent: str, policy: Policy, seed: int, explore: bool) -> None:
        self._agent, self._policy, self._explore = agent, policy, explore
        self._draws = generator(seed, agent)
        self._state: Arrays | None = None

    def act(self, batch: Batch) -> tuple[NDArray, Move]:
        """Actions (1, …) for a batch of this agent alone, and the move."""
        output = policy_output(self._policy, batch.observations, self._state, [self._draws], self._explore)
        for fault in output.faults.values():
            raise GameCrashed(f"{self._agent} has no action{cause(fault)}") from fault
        self._state, inputs = output.state, output.dist_inputs
        observation = {name: array[0] for name, array in batch.observations.items()}
        action, value = output.actions[0].tolist(), expected_return(output)
        return output.actions, Move(self._agent, observation, action, None if inputs is None else inputs[0], value)


def _acting(turn: Turn, agents: Sequence[str]) -> tuple[str, ...]:
    return tuple(agents[agent] for agent in turn.batches)
