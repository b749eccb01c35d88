"""Opponents in training: versions, drawn from their distributions where they have some, and scripts, as they play."""

from collections.abc import Sequence

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
from training.sampling.memories import Memories
from training.sampling.seats import Opposing

VALUE_BASED = ("dqn", "qmix")
"""Algorithms whose graphs answer values of actions, not a distribution to draw from: they play greedily."""


class Opponents:
    """The loaded policies of all opponents, with the memories of those that have one."""

    def __init__(self, configs: Sequence[OpponentConfig], interface: Interface, storage: Storage | None) -> None:
        """Raises what loading them raises, and ConfigError for versions without a storage to load them from."""
        self._policies = {
            Opposing(config.ref, policy_id): policy
            for config in configs
            for policy_id, policy in _load(config.ref, interface, storage).values()
        }
        self._greedy = {config.ref for config in configs if _is_greedy(config.ref, storage)}
        self._memories = {
            seat: Memories({key: rows[0] for key, rows in initial.items()})
            for seat, policy in self._policies.items()
            if isinstance(policy, OnnxPolicy) and (initial := policy.initial_state(1))
        }

    def act(self, seat: Opposing, batch: Batch, rng: np.random.Generator) -> NDArray:
        """Actions of the environment's space for the rows that `seat` plays."""
        policy, memories = self._policies[seat], self._memories.get(seat)
        answer = policy.act(
            batch.observations,
            state=memories.before(batch) if memories else None,
            explore=isinstance(policy, OnnxPolicy) and seat.ref not in self._greedy,
            rng=[rng] * len(batch.copies),
        )
        if memories and answer.state is not None:
            memories.keep(batch, answer.state)
        return answer.actions

    def forget(self, copy: int) -> None:
        """The episode in `copy` is over."""
        for memories in self._memories.values():
            memories.forget(copy)


def _is_greedy(ref: str, storage: Storage | None) -> bool:
    parsed = parse_ref(ref)
    if isinstance(parsed, ScriptRef) or storage is None:
        return False
    registry = Registry.open(storage)
    try:
        return registry.resolve(parsed).manifest.algorithm in VALUE_BASED
    finally:
        registry.close()


def _load(ref: str, interface: Interface, storage: Storage | None) -> dict[str, tuple[str, Policy]]:
    if isinstance(parse_ref(ref), ScriptRef):
        return contestant(ref, None, interface)
    if storage is None:
        raise ConfigError(f"training.opponents: {ref} is a version, and there is no storage to load it from")
    registry = Registry.open(storage)
    try:
        return contestant(ref, registry, interface)
    finally:
        registry.close()
