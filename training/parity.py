"""The proof that an exported graph acts as the trained module does, on observations from play."""

import itertools
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.torch import TorchRLModule

from league.config import EnvironmentConfig
from league.environments.lockstep import stepping
from league.environments.stepping import Episode
from league.errors import ParityError
from league.interface import Interface
from league.policies.onnx import OnnxPolicy
from league.registry.manifest import Parity
from league.seeds import derive, generator
from league.spaces import Discrete
from training.modules.actor_critic import MASKED
from training.sampling import categorical

OBSERVATIONS = 2048
"""Observations that each policy is compared on."""
NEAR_TIE = 1e-5
"""Two actions whose logits are closer may swap by the order of summation in another runtime."""
TOLERANCE = 1e-3
"""Largest difference of a logit x, relative to 1 + |x|: beyond it, the two would not explore alike."""
COPIES = 32
MOVES_PER_OBSERVATION = 100
"""Bounds the play where some policy hardly ever acts."""

Batches = list[dict[str, NDArray]]


def gather(
    environment: EnvironmentConfig, interface: Interface, modules: dict[str, TorchRLModule], seed: int
) -> dict[str, Batches]:
    """Play until each policy has met OBSERVATIONS observations; policy → batches of them, (k, …) each.

    Every other copy explores by the modules' own distributions, the rest is uniformly random, so that both what the
    policies do meet and what they do not is among them. Raises ParityError if a policy does not get to act enough.
    """
    rng = generator(seed, "parity")
    batched = stepping(environment, COPIES)
    resets = itertools.count()
    groups = [[(interface.policies[agent], explores) for agent in batched.agents] for explores in (False, True)]
    met: dict[str, Batches] = defaultdict(list)
    try:
        turn = batched.start(lambda copy: Episode(derive(seed, "parity", next(resets)), groups[copy % 2]))
        for _ in range(MOVES_PER_OBSERVATION * OBSERVATIONS // COPIES):
            actions = {}
            for (policy, explores), batch in turn.batches.items():
                met[policy].append(batch.observations)
                logits = _logits(modules[policy], batch.observations)
                logits = logits if explores else np.where(logits > MASKED / 2, np.float32(0), logits)
                chosen = categorical.sample(categorical.log_softmax(logits), rng)
                actions[policy, explores] = chosen + _first_action(interface, policy)
            if all(_count(met[policy]) >= OBSERVATIONS for policy in interface.policy_ids):
                return dict(met)
            turn = batched.step(actions)
    finally:
        batched.close()
    rarest = min(interface.policy_ids, key=lambda policy: _count(met[policy]))
    raise ParityError(
        f"policy {rarest} met {_count(met[rarest])} observations in "
        f"{MOVES_PER_OBSERVATION * OBSERVATIONS} moves, expected {OBSERVATIONS}"
    )


def prove(path: Path, policy: str, module: TorchRLModule, batches: Batches, first_action: int = 0) -> Parity:
    """Compare the graph at `path`, as it is served, with `module`, row by row.

    Raises ParityError if a greedy action differs that is no near tie, or a logit by more than TOLERANCE.
    """
    graph = OnnxPolicy(path)
    near_ties = mismatches = 0
    largest = worst = 0.0
    for observations in batches:
        expected = _logits(module, observations)
        if not np.isfinite(expected).all():
            raise ParityError(f"policy {policy} has logits that are not finite: training has diverged")
        rows = len(expected)
        greedy = graph.act(observations).actions - first_action
        answered = graph.act(observations, explore=True, rng=[np.random.default_rng(0)] * rows).dist_inputs
        differs = greedy != expected.argmax(axis=-1)
        near_ties += int((differs & (_margin(expected) < NEAR_TIE)).sum())
        mismatches += int((differs & (_margin(expected) >= NEAR_TIE)).sum())
        difference = np.abs(answered - expected)
        largest = max(largest, float(difference.max()))
        worst = max(worst, float((difference / (1 + np.abs(expected))).max()))
    count = _count(batches)
    if mismatches or not worst <= TOLERANCE:
        raise ParityError(
            f"the graph of policy {policy} differs from its module on {mismatches} of {count} greedy actions, "
            f"and by up to {largest:g} in a logit"
        )
    return Parity(observations=count, mismatches=mismatches, near_ties=near_ties, max_difference=largest)


def _logits(module: TorchRLModule, observations: dict[str, NDArray]) -> NDArray:
    tensors = {name: torch.from_numpy(array) for name, array in observations.items()}
    return module.forward_inference({Columns.OBS: tensors})[Columns.ACTION_DIST_INPUTS].numpy()


def _margin(logits: NDArray) -> NDArray:
    """How far the best logit is above the second, per row; infinite where there is but one action."""
    if logits.shape[-1] < 2:
        return np.full(len(logits), np.inf)
    ordered = np.sort(logits, axis=-1)
    return ordered[:, -1] - ordered[:, -2]


def _first_action(interface: Interface, policy: str) -> int:
    space = interface.of_policy(policy).action
    return space.start if isinstance(space, Discrete) else 0


def _count(batches: Batches) -> int:
    return sum(len(next(iter(batch.values()))) for batch in batches)
