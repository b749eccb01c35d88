"""Opponents in training: matchups per episode, random openings, and the opponents' actions."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.config.opponents import OpponentConfig
from league.environments.stepping import Batch, Indices
from league.errors import ConfigError, GameCrashed, one_line
from league.interface import Interface
from league.policies.bots import Bot
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Policy
from league.refs import ScriptRef, parse_ref
from league.registry.registry import Registry
from league.settings import Storage
from training.sampling.recurrent_state import RecurrentStates


@dataclass(frozen=True, slots=True)
class OpponentPolicy:
    """An opponent's policy: a reference, and one of its policies."""

    ref: str
    policy: str


@dataclass(frozen=True, slots=True)
class RandomMoves:
    """Random moves; `policy` has the spaces."""

    policy: str


Controller = str | OpponentPolicy | RandomMoves
"""Who controls an agent: one of the league's policies, by id, an opponent, or nobody."""


class Controllers:
    """Numbers all controllers, for use as groups. The league's own policies come first, in the interface's order."""

    def __init__(self, interface: Interface, opponents: Sequence[OpponentConfig]) -> None:
        policies = interface.policy_ids
        self._all: list[Controller] = [*policies, *(RandomMoves(policy) for policy in policies)]
        self._all += [OpponentPolicy(opponent.ref, policy) for opponent in opponents for policy in policies]
        self._number = {controller: number for number, controller in reversed(list(enumerate(self._all)))}

    def __getitem__(self, group: int) -> Controller:
        return self._all[group]

    def groups(self, controllers: Sequence[Controller]) -> Indices:
        """Return the numbers of some controllers."""
        return np.array([self._number[controller] for controller in controllers], dtype=np.int64)


class Matchups:
    """Draws for each episode an opponent or none, by their shares, and the side that learns."""

    def __init__(
        self, interface: Interface, opponents: Sequence[OpponentConfig], agents: Sequence[str], controllers: Controllers
    ) -> None:
        """Raises ConfigError if opponents are configured and the league has one side only."""
        if opponents and len(interface.sides) < 2:
            raise ConfigError("training.opponents: the league has one side only: divide the agents into sides")
        self._shares = np.cumsum([opponent.share for opponent in opponents])
        policies = [interface.policies[agent] for agent in agents]
        self._own = controllers.groups(policies)
        # (opponents, agents)
        self._opposing = np.array(
            [
                controllers.groups([OpponentPolicy(opponent.ref, policy) for policy in policies])
                for opponent in opponents
            ]
        )
        # (sides, agents)
        self._sides = np.array([[agent in members for agent in agents] for members in interface.sides.values()])

    def draw(self, episodes: int, rng: np.random.Generator) -> Indices:
        """Return the groups of all agents in some new episodes, (episodes, agents)."""
        groups = np.tile(self._own, (episodes, 1))
        if len(self._shares):
            opponents = np.searchsorted(self._shares, rng.random(episodes), side="right")
            opposed = np.flatnonzero(opponents < len(self._shares))
            learning = self._sides[rng.integers(len(self._sides), size=len(opposed))]
            groups[opposed] = np.where(learning, groups[opposed], self._opposing[opponents[opposed]])
        return groups


class Openings:
    """Starts each episode with 0 to `plies` random steps, uniformly distributed.

    Random openings reach positions that self-play alone does not visit; evaluation matches have openings, too.
    """

    def __init__(self, plies: int, movers: Indices, num_envs: int) -> None:
        """movers: the groups of all agents during the opening, (agents,)."""
        self._plies, self._movers = plies, movers
        self._left = np.zeros(num_envs, np.int64)
        self._waiting = np.zeros((num_envs, len(movers)), np.int64)

    def begin(self, envs: Indices, groups: Indices, rng: np.random.Generator) -> Indices:
        """Return the initial groups of the agents in new episodes. groups: after the opening, (m, agents)."""
        if not self._plies:
            return groups
        self._left[envs], self._waiting[envs] = rng.integers(self._plies + 1, size=len(envs)), groups
        return np.where(self._left[envs, np.newaxis] > 0, self._movers, groups)

    def step(self) -> tuple[Indices, Indices]:
        """Count a step in all environments. Return those whose opening ends with it, and their groups after it."""
        ended = np.flatnonzero(self._left == 1)
        self._left = np.maximum(self._left - 1, 0)
        return ended, self._waiting[ended]


VALUE_BASED_ALGORITHMS = ("dqn", "qmix")
"""Algorithms whose graphs output action values instead of a distribution: they play greedily."""


class Opponents:
    """The loaded policies of all opponents, with their recurrent states."""

    def __init__(
        self, configs: Sequence[OpponentConfig], interface: Interface, storage: Storage | None, num_envs: int
    ) -> None:
        """Raises what loading raises, and ConfigError for versions without a storage to load them from."""
        self._policies = {
            OpponentPolicy(config.ref, policy_id): policy
            for config in configs
            for policy_id, policy in _load(config.ref, interface, storage).values()
        }
        self._greedy = {config.ref for config in configs if _is_greedy(config.ref, storage)}
        self._recurrent_states = {
            opponent: RecurrentStates(
                {key: np.asarray(rows[0], rows.dtype) for key, rows in initial.items()}, num_envs, len(interface.agents)
            )
            for opponent, policy in self._policies.items()
            if isinstance(policy, OnnxPolicy | Bot) and (initial := policy.initial_state(1))
        }

    def act(self, opponent: OpponentPolicy, batch: Batch, rng: np.random.Generator) -> NDArray:
        """Return actions in the environment's space for the rows that an opponent controls."""
        policy, states = self._policies[opponent], self._recurrent_states.get(opponent)
        answer = policy.act(
            batch.observations,
            state=states.get(batch) if states else None,
            explore=isinstance(policy, OnnxPolicy) and opponent.ref not in self._greedy,
            rng=[rng] * len(batch),
        )
        for fault in answer.faults.values():
            raise GameCrashed(f"training.opponents: {opponent.ref}: {one_line(fault, with_type=True)}") from fault
        if states and answer.state is not None:
            states.update(batch, answer.state)
        return answer.actions

    def forget(self, envs: Indices) -> None:
        """The episodes in `envs` are over."""
        for states in self._recurrent_states.values():
            states.forget(envs)


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
