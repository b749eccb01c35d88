"""Checks that an exported graph acts as the trained module, on observations from play."""

import itertools
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns

from league.config.environment import EnvironmentConfig
from league.environments.lockstep import stock_stepping
from league.environments.stepping import Indices, Starts
from league.errors import ParityError
from league.interface import Interface
from league.policies.actions import to_environment
from league.policies.onnx import LAST_ACTION, OnnxPolicy
from league.policies.probes import Probes, excused, same
from league.random.seeds import derive, generator
from league.registry.storage.manifest import Parity
from league.spaces import ACTION_MASK, Space
from training.export.onnx_export import state_names
from training.modules.policy_module import PolicyModule
from training.sampling.distributions import distribution
from training.sampling.env_runner import one_thread
from training.sampling.recurrent_state import RecurrentStates
from training.sampling.reset_seeds import SEEDS

TARGET_OBSERVATIONS = 2048
"""Observations per policy for the comparison."""
MAX_MEGABYTES = 128
"""Large observations are limited to this size, but not below MIN_OBSERVATIONS."""
MIN_OBSERVATIONS = 256
ENOUGH_SECONDS, MOST_SECONDS = 8.0, 120.0
"""Seconds of play after which MIN_OBSERVATIONS suffice, and after which a policy with fewer has failed."""
NUM_ENVS = 8
TOLERANCE = 1e-3
"""Maximum difference of distribution inputs and states, relative to 1 + |x|: above it, exploration would differ."""
PROBES, MAX_PROBE_BYTES = 32, 2**20
"""Probes recorded per policy; fewer if their observations exceed this size."""


@dataclass(frozen=True, slots=True)
class ObservedBatch:
    """k observations of a policy, and the recurrent states before them.

    observations: ONNX input name → (k, …). state: key → (k, width), with the module's keys; empty if not recurrent.
    """

    observations: dict[str, NDArray]
    state: dict[str, NDArray]

    def __len__(self) -> int:
        return len(next(iter(self.observations.values())))


@one_thread()
def collect_observations(
    environment: EnvironmentConfig, interface: Interface, modules: Mapping[str, PolicyModule], seed: int
) -> dict[str, list[ObservedBatch]]:
    """Play until each policy has enough observations; return policy → batches of them, with recurrent states.

    Every other environment samples from the modules' distributions, and the rest plays at random, to include
    observations that the policies do and do not reach. Raises ParityError if a policy does not act often enough.
    """
    rng = generator(seed, "parity")
    batched = stock_stepping(environment, NUM_ENVS)
    resets = itertools.count()
    policies = interface.policy_ids
    # Group 2 i is policy i at random, group 2 i + 1 the same exploring.
    groups = 2 * np.array([policies.index(interface.policies[agent]) for agent in batched.agents])
    recurrent_states = {
        policy: RecurrentStates(module.get_initial_state(), NUM_ENVS, len(batched.agents))
        for policy, module in modules.items()
    }
    distributions = {policy: distribution(interface.of_policy(policy).action) for policy in modules}
    met: dict[str, list[ObservedBatch]] = defaultdict(list)
    began = time.monotonic()

    def next_episodes(envs: Indices) -> Starts:
        seeds = [derive(seed, "parity", next(resets)) % SEEDS for _ in envs]
        return Starts(envs, np.array(seeds), groups + envs[:, np.newaxis] % 2)

    try:
        turn = batched.start(next_episodes)
        while not _is_enough(met, interface, time.monotonic() - began):
            for states in recurrent_states.values():
                states.forget(turn.finished)
            actions = {}
            for group, batch in turn.batches.items():
                policy, explores = policies[group // 2], group % 2
                states = recurrent_states[policy]
                situation = ObservedBatch(batch.observations, states.get(batch))
                met[policy].append(situation)
                dist_inputs, state = module_outputs(modules[policy], situation)
                states.update(batch, state)
                drawn = distributions[policy]
                if explores:
                    raw, _ = drawn.sample(dist_inputs, rng)
                else:
                    raw, _ = drawn.uniform(batch.observations.get(ACTION_MASK), len(situation), rng)
                actions[group] = to_environment(raw, interface.of_policy(policy).action)
            turn = batched.step(actions)
    finally:
        batched.close()
    return dict(met)


@one_thread()
def check_parity(path: Path, policy: str, module: PolicyModule, batches: list[ObservedBatch], space: Space) -> Parity:
    """Compare the served graph at `path` with `module`, row by row. space: of the actions.

    Raises ParityError if a greedy action differs other than in a near tie, or if a distribution input or a state
    differs by more than TOLERANCE. The previous action in a state is the greedy one, which is compared already.
    """
    graph = OnnxPolicy(path)
    near_ties = mismatches = 0
    largest = worst = 0.0
    for situation in batches:
        expected, state = module_outputs(module, situation)
        if not np.isfinite(expected).all():
            raise ParityError(f"policy {policy} has non-finite outputs: training has diverged")
        mode = module.distribution.mode(torch.from_numpy(expected)).numpy()
        exported = graph.distribution(situation.observations, state=_state_in(situation.state) or None)
        assert exported.dist_inputs is not None
        wrong, tied = count_differences(exported.actions, to_environment(mode, space), expected, space)
        mismatches, near_ties = mismatches + wrong, near_ties + tied
        largest = max(largest, float(np.abs(exported.dist_inputs - expected).max()))
        pairs = [(exported.dist_inputs, expected)]
        after = exported.state or {}
        pairs += [
            (after[name], module_output) for name, module_output in _state_in(state).items() if name != LAST_ACTION
        ]
        worst = max(
            worst,
            *(
                float((np.abs(graph_output - module_output) / (1 + np.abs(module_output))).max())
                for graph_output, module_output in pairs
            ),
        )
    count = sum(map(len, batches))
    if mismatches or not worst <= TOLERANCE:
        raise ParityError(
            f"the graph of policy {policy} differs from its module on {mismatches} of {count} greedy actions, "
            f"and by up to {worst:g}, relative to 1 + |x|, in a distribution input or a state"
        )
    return Parity(observations=count, mismatches=mismatches, near_ties=near_ties, max_difference=largest)


def probes(path: Path, batches: list[ObservedBatch]) -> Probes:
    """Return evenly spaced observations with the actions of the graph at `path`."""
    starts = np.cumsum([0, *map(len, batches)])
    size = sum(array[0].nbytes for array in batches[0].observations.values())
    count = min(PROBES, max(1, MAX_PROBE_BYTES // size), int(starts[-1]))
    rows = np.linspace(0, starts[-1] - 1, count).astype(int)
    samples = [(batches[i], row - starts[i]) for row in rows for i in [int(np.searchsorted(starts, row, "right")) - 1]]
    observations = {
        name: np.stack([met.observations[name][row] for met, row in samples]) for name in batches[0].observations
    }
    state = _state_in({key: np.stack([met.state[key][row] for met, row in samples]) for key in batches[0].state})
    return Probes(observations, state, OnnxPolicy(path).act(observations, state=state or None).actions)


def _state_in(state: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """Rename a module's state to the graph's inputs."""
    return dict(zip(state_names(state), state.values(), strict=True))


def module_outputs(module: PolicyModule, situation: ObservedBatch) -> tuple[NDArray, dict[str, NDArray]]:
    """Return a module's distribution inputs, (k, d), and the states after."""
    outputs = module.forward_inference(
        {
            Columns.OBS: {name: torch.from_numpy(array) for name, array in situation.observations.items()},
            Columns.STATE_IN: {key: torch.from_numpy(array) for key, array in situation.state.items()},
        }
    )
    state = {key: value.numpy() for key, value in outputs.get(Columns.STATE_OUT, {}).items()}
    return outputs[Columns.ACTION_DIST_INPUTS].numpy(), state


def _is_enough(met: Mapping[str, list[ObservedBatch]], interface: Interface, seconds: float) -> bool:
    lacking = {policy: _wanted(met[policy], seconds) - _count(met[policy]) for policy in interface.policy_ids}
    rarest = max(lacking, key=lambda policy: lacking[policy])
    if lacking[rarest] > 0 and seconds > MOST_SECONDS:
        raise ParityError(
            f"policy {rarest} received {_count(met[rarest])} observations in {seconds:.0f} s of play, "
            f"expected {MIN_OBSERVATIONS}"
        )
    return lacking[rarest] <= 0


def _wanted(batches: list[ObservedBatch], seconds: float) -> int:
    if not batches or seconds > ENOUGH_SECONDS:
        return MIN_OBSERVATIONS
    size = sum(array[0].nbytes for array in batches[0].observations.values())
    return min(TARGET_OBSERVATIONS, max(MIN_OBSERVATIONS, MAX_MEGABYTES * 2**20 // size))


def _count(batches: list[ObservedBatch]) -> int:
    return sum(map(len, batches))


def count_differences(actions: NDArray, expected: NDArray, dist_inputs: NDArray, space: Space) -> tuple[int, int]:
    """Return the number of rows whose actions differ, and of those that differ in near ties only."""
    alike, fine = same(actions, expected, space), excused(actions, expected, dist_inputs, space)
    return int((~fine).sum()), int((fine & ~alike).sum())
