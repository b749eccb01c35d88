"""Opponents in training: matchups per episode, random openings, and the opponents' actions."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.environments.stepping import Batch
from league.errors import ConfigError
from league.interface import Interface
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.refs import ScriptRef, parse_ref
from league.registry.registry import Registry
from league.settings import Storage
from league.training_config import OpponentConfig
from training.sampling.recurrent_state import RecurrentStates


@dataclass(frozen=True, slots=True)
class OpponentPolicy:
    """The group of agents that an opponent controls: a reference, and one of its policies."""

    ref: str
    policy: str


Controller = str | OpponentPolicy
"""Who controls an agent: one of the league's policies, by id, or an opponent."""


class Matchups:
    """Draws for each episode an opponent or none, by their shares, and the side that learns."""

    def __init__(self, interface: Interface, opponents: Sequence[OpponentConfig], agents: Sequence[str]) -> None:
        """Raises ConfigError if opponents are configured and the league has one side only."""
        if opponents and len(interface.sides) < 2:
            raise ConfigError("training.opponents: the league has one side only: divide the agents into sides")
        self._refs = [opponent.ref for opponent in opponents]
        self._shares = np.cumsum([opponent.share for opponent in opponents])
        self._agents = tuple(agents)
        self._own: tuple[Controller, ...] = tuple(interface.policies[agent] for agent in agents)
        self._sides = [frozenset(members) for members in interface.sides.values()]

    def draw(self, rng: np.random.Generator) -> tuple[Controller, ...]:
        """Return the controller of each agent in the next episode."""
        if not self._refs:
            return self._own
        index = int(np.searchsorted(self._shares, rng.random(), side="right"))
        if index == len(self._refs):
            return self._own
        learning = self._sides[int(rng.integers(len(self._sides)))]
        return tuple(
            policy if agent in learning else OpponentPolicy(self._refs[index], str(policy))
            for agent, policy in zip(self._agents, self._own, strict=True)
        )


@dataclass(frozen=True, slots=True)
class RandomMoves:
    """The group of agents that currently move at random; `policy` has their spaces."""

    policy: str


class Openings:
    """Starts each episode with 0 to `plies` random steps, uniformly distributed.

    Random openings reach positions that self-play alone does not visit; evaluation matches have openings, too.
    """

    def __init__(self, plies: int, policies: Sequence[str], num_envs: int) -> None:
        """policies: the policy of each agent."""
        self._plies = plies
        self._left = [0] * num_envs
        self._waiting: list[tuple[Controller, ...]] = [()] * num_envs
        self._movers = tuple(RandomMoves(policy) for policy in policies)

    def begin(
        self, env: int, controllers: tuple[Controller, ...], rng: np.random.Generator
    ) -> tuple[Controller, ...] | tuple[RandomMoves, ...]:
        """Return the initial groups of the agents in an episode. controllers: of the agents after the opening."""
        if not self._plies:
            return controllers
        self._left[env], self._waiting[env] = int(rng.integers(self._plies + 1)), controllers
        return self._movers if self._left[env] else controllers

    def step(self) -> Iterator[tuple[int, tuple[Controller, ...]]]:
        """Count a step in all environments; yield those whose opening ends with it, and their controllers."""
        for env, left in enumerate(self._left) if self._plies else ():
            self._left[env] = max(left - 1, 0)
            if left == 1:
                yield env, self._waiting[env]


VALUE_BASED_ALGORITHMS = ("dqn", "qmix")
"""Algorithms whose graphs output action values instead of a distribution: they play greedily."""


class Opponents:
    """The loaded policies of all opponents, with their recurrent states."""

    def __init__(self, configs: Sequence[OpponentConfig], interface: Interface, storage: Storage | None) -> None:
        """Raises what loading raises, and ConfigError for versions without a storage to load them from."""
        self._policies = {
            OpponentPolicy(config.ref, policy_id): policy
            for config in configs
            for policy_id, policy in _load(config.ref, interface, storage).values()
        }
        self._greedy = {config.ref for config in configs if _is_greedy(config.ref, storage)}
        self._recurrent_states = {
            opponent: RecurrentStates({key: rows[0] for key, rows in initial.items()})
            for opponent, policy in self._policies.items()
            if isinstance(policy, OnnxPolicy) and (initial := policy.initial_state(1))
        }

    def act(self, opponent: OpponentPolicy, batch: Batch, rng: np.random.Generator) -> NDArray:
        """Return actions in the environment's space for the rows that an opponent controls."""
        policy, states = self._policies[opponent], self._recurrent_states.get(opponent)
        answer = policy.act(
            batch.observations,
            state=states.get(batch) if states else None,
            explore=isinstance(policy, OnnxPolicy) and opponent.ref not in self._greedy,
            rng=[rng] * len(batch.envs),
        )
        if states and answer.state is not None:
            states.update(batch, answer.state)
        return answer.actions

    def forget(self, env: int) -> None:
        """The episode in `env` is over."""
        for states in self._recurrent_states.values():
            states.forget(env)


def _is_greedy(ref: str, storage: Storage | None) -> bool:
    parsed = parse_ref(ref)
    if isinstance(parsed, ScriptRef) or storage is None:
        return False
    with closing(Registry.open(storage)) as registry:
        return registry.versions.resolve(parsed).manifest.algorithm in VALUE_BASED_ALGORITHMS


def _load(ref: str, interface: Interface, storage: Storage | None) -> dict[str, tuple[str, Policy]]:
    if isinstance(parse_ref(ref), ScriptRef):
        return contestant(ref, None, interface)
    if storage is None:
        raise ConfigError(f"training.opponents: {ref} is a version, but no storage is given to load it from")
    with closing(Registry.open(storage)) as registry:
        return contestant(ref, registry, interface)
