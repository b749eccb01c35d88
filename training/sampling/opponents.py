"""Opponents in training: matchups per episode, random openings, and the opponents' actions."""

from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.config.opponents import OpponentConfig
from league.environments.stepping import Batch, Indices
from league.errors import ConfigError, GameCrashed, one_line
from league.interface import Interface
from league.policies.bots import Bot
from league.policies.loading import contestant, players
from league.policies.onnx import OnnxPolicy
from league.policies.open_inference import OpenInferencePolicy
from league.policies.policy import Policy
from league.refs import CheckpointRef, parse_ref
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

    def __init__(self, interface: Interface) -> None:
        policies = interface.policy_ids
        self._policies = policies
        self._all: list[Controller] = [*policies, *(RandomMoves(policy) for policy in policies)]
        self._number = {controller: number for number, controller in enumerate(self._all)}

    def __getitem__(self, group: int) -> Controller:
        return self._all[group]

    def add(self, ref: str) -> None:
        """Number the policies of an opponent."""
        for policy in self._policies:
            controller = OpponentPolicy(ref, policy)
            self._number[controller] = len(self._all)
            self._all.append(controller)

    def groups(self, controllers: Sequence[Controller]) -> Indices:
        """Return the numbers of some controllers."""
        return np.array([self._number[controller] for controller in controllers], dtype=np.int64)


@dataclass(frozen=True, slots=True)
class Pairings:
    """Who plays m new episodes.

    groups: of all agents, (m, agents). opponents: their numbers, -1 in self-play, (m,). sides: the number of the side
    that learns, 0 in self-play, (m,).
    """

    groups: Indices
    opponents: Indices
    sides: Indices


class Matchups:
    """Draws for each episode an opponent or none, by their shares, and the side that learns."""

    def __init__(self, interface: Interface, agents: Sequence[str], controllers: Controllers) -> None:
        self._controllers = controllers
        self._policies = [interface.policies[agent] for agent in agents]
        self._own = controllers.groups(self._policies)
        self.sides = np.array([[agent in members for agent in agents] for members in interface.sides.values()])
        """Which agents belong to each side, (sides, agents)."""
        self.refs: list[str] = []
        """All opponents until now; their positions are their numbers."""
        self._opposing = np.zeros((0, len(agents)), np.int64)
        self.exchange(())

    def exchange(self, opponents: Sequence[OpponentConfig]) -> None:
        """Draw from these opponents from now on."""
        for opponent in opponents:
            if opponent.ref not in self.refs:
                self._controllers.add(opponent.ref)
                self.refs.append(opponent.ref)
                groups = self._controllers.groups([OpponentPolicy(opponent.ref, policy) for policy in self._policies])
                self._opposing = np.concatenate([self._opposing, groups[np.newaxis]])
        self._numbers = np.array([self.refs.index(opponent.ref) for opponent in opponents], dtype=np.int64)
        self._shares = np.cumsum([opponent.share for opponent in opponents])

    def draw(self, episodes: int, rng: np.random.Generator) -> Pairings:
        """Draw who plays some new episodes."""
        groups = np.tile(self._own, (episodes, 1))
        numbers, sides = np.full(episodes, -1), np.zeros(episodes, np.int64)
        if len(self._shares):
            drawn = np.searchsorted(self._shares, rng.random(episodes), side="right")
            opposed = np.flatnonzero(drawn < len(self._shares))
            numbers[opposed] = self._numbers[drawn[opposed]]
            sides[opposed] = rng.integers(len(self.sides), size=len(opposed))
            learning = self.sides[sides[opposed]]
            groups[opposed] = np.where(learning, groups[opposed], self._opposing[numbers[opposed]])
        return Pairings(groups, numbers, sides)


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

    def step(self, acting: NDArray[np.bool_]) -> tuple[Indices, Indices]:
        """Count a step in some environments. Return those whose opening ends with it, and their groups after it.

        acting: (environments,).
        """
        ended = np.flatnonzero((self._left == 1) & acting)
        self._left = np.maximum(self._left - acting, 0)
        return ended, self._waiting[ended]


LOADED = 16
"""Opponents from the league that a runner keeps loaded, unless more of them play: loading one takes as long as hundreds
of steps."""


class Opponents:
    """The loaded policies of all opponents, with their recurrent states."""

    def __init__(
        self, fixed: Sequence[OpponentConfig], interface: Interface, storage: Storage | None, num_envs: int
    ) -> None:
        """Raises what loading raises, and ConfigError for versions without a storage to load them from."""
        self._interface, self._storage, self._num_envs = interface, storage, num_envs
        self._policies: dict[OpponentPolicy, Policy] = {}
        self._recurrent_states: dict[OpponentPolicy, RecurrentStates] = {}
        self._fixed = frozenset(opponent.ref for opponent in fixed)
        for ref in self._fixed:
            self._load(ref)
        self._exchanged: list[str] = []

    def exchange(self, refs: Collection[str], playing: Collection[str]) -> None:
        """Load opponents, and unload those that were not requested for longest.

        playing: opponents in open episodes, which stay loaded. Raises what loading raises.
        """
        for ref in refs:
            if ref in self._exchanged:
                self._exchanged.remove(ref)
            elif ref not in self._fixed:
                self._load(ref)
            if ref not in self._fixed:
                self._exchanged.append(ref)
        idle = [ref for ref in self._exchanged if ref not in refs and ref not in playing]
        for ref in idle[: max(len(self._exchanged) - LOADED, 0)]:
            self._exchanged.remove(ref)
            for policy_id in self._interface.policy_ids:
                opponent = OpponentPolicy(ref, policy_id)
                del self._policies[opponent]
                self._recurrent_states.pop(opponent, None)

    def _load(self, ref: str) -> None:
        for policy_id, policy in policies_of(ref, self._interface, self._storage, "training.opponents").items():
            opponent = OpponentPolicy(ref, policy_id)
            self._policies[opponent] = policy
            if isinstance(policy, OnnxPolicy | OpenInferencePolicy | Bot) and (initial := policy.initial_state(1)):
                first = {key: np.asarray(rows[0], rows.dtype) for key, rows in initial.items()}
                self._recurrent_states[opponent] = RecurrentStates(first, self._num_envs, len(self._interface.agents))

    def act(self, opponent: OpponentPolicy, batch: Batch, rng: np.random.Generator) -> NDArray:
        """Return actions in the environment's space for the rows that an opponent controls."""
        policy, states = self._policies[opponent], self._recurrent_states.get(opponent)
        answer = policy.act(
            batch.observations,
            state=states.get(batch) if states else None,
            explore=isinstance(policy, OnnxPolicy),
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


def policies_of(ref: str, interface: Interface, storage: Storage | None, setting: str) -> dict[str, Policy]:
    """Return policy id → policy of a script, a bot, a remote model or a version.

    Raises what loading raises, and ConfigError, which names the setting, for a version without a storage.
    """
    if not isinstance(parse_ref(ref), CheckpointRef):
        return dict(contestant(ref, None, interface).values())
    if storage is None:
        raise ConfigError(f"{setting}: {ref} is a version, but no storage is given to load it from")
    with closing(Registry.open(storage)) as registry:
        return dict(contestant(ref, registry, interface).values())


def without_mixtures(opponents: Sequence[OpponentConfig], storage: Storage | None) -> tuple[OpponentConfig, ...]:
    """Return opponents in which each mixture is replaced by its members: an episode has one of them."""
    if storage is None or not any(isinstance(parse_ref(opponent.ref), CheckpointRef) for opponent in opponents):
        return tuple(opponents)
    with closing(Registry.open(storage)) as registry:
        return tuple(
            OpponentConfig(ref=ref, share=opponent.share * probability)
            for opponent in opponents
            for ref, probability in players(opponent.ref, registry).items()
        )
