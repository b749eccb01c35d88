"""The proof that an exported graph acts as the trained module does, on observations from play."""

import itertools
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns

from league.config import EnvironmentConfig
from league.environments.lockstep import stepping
from league.environments.stepping import Episode
from league.errors import ParityError
from league.interface import Interface
from league.policies.actions import to_environment
from league.policies.agreement import excused, same
from league.policies.onnx import OnnxPolicy
from league.policies.probes import Probes
from league.registry.manifest import Parity
from league.seeds import derive, generator
from league.spaces import ACTION_MASK, Space
from training.export import state_names
from training.modules.acting import Acting
from training.sampling.distributions import distribution
from training.sampling.memories import Memories
from training.sampling.reset_seeds import SEEDS

OBSERVATIONS = 2048
"""Observations that each policy is compared on."""
MEGABYTES = 128
"""Large observations are compared on as many as fit into this, but on no fewer than FEWEST."""
FEWEST = 256
ENOUGH_SECONDS, MOST_SECONDS = 8.0, 120.0
"""Of play, after which FEWEST observations are enough, and after which a policy with fewer counts as never acting."""
COPIES = 8
TOLERANCE = 1e-3
"""Largest difference of an input x of the distribution, or of a number of the state, relative to 1 + |x|: beyond it,
the two would not explore alike."""
PROBES, PROBE_BYTES = 32, 2**20
"""Probes that are recorded of a policy, fewer where their observations take more than that."""


@dataclass(frozen=True, slots=True)
class Met:
    """k situations of a policy.

    observations: ONNX input name → (k, …). state: key → (k, width), as the module names it; empty without a memory.
    """

    observations: dict[str, NDArray]
    state: dict[str, NDArray]

    def __len__(self) -> int:
        return len(next(iter(self.observations.values())))


@dataclass(frozen=True, slots=True)
class _Group:
    """Agents of one policy that explore by its own distributions, or play at random."""

    policy: str
    explores: bool


@contextmanager
def _one_thread() -> Iterator[None]:
    """For passes over a few rows, several threads wait for one another longer than they work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@_one_thread()
def gather(
    environment: EnvironmentConfig, interface: Interface, modules: Mapping[str, Acting], seed: int
) -> dict[str, list[Met]]:
    """Play until each policy has met enough observations; policy → batches of them, with its states carried along.

    Every other copy explores by the modules' own distributions, the rest is random, so that both what the policies do
    meet and what they do not is among them. Raises ParityError if a policy does not get to act enough.
    """
    rng = generator(seed, "parity")
    batched = stepping(environment, COPIES)
    resets = itertools.count()
    groups = [[_Group(interface.policies[agent], explores) for agent in batched.agents] for explores in (False, True)]
    memories = {policy: Memories(module.get_initial_state()) for policy, module in modules.items()}
    distributions = {policy: distribution(interface.of_policy(policy).action) for policy in modules}
    met: dict[str, list[Met]] = defaultdict(list)
    began = time.monotonic()
    try:
        turn = batched.start(lambda copy: Episode(derive(seed, "parity", next(resets)) % SEEDS, groups[copy % 2]))
        while not _is_enough(met, interface, time.monotonic() - began):
            for copy, memory in itertools.product(turn.finished, memories.values()):
                memory.forget(copy)
            actions = {}
            for group, batch in turn.batches.items():
                memory = memories[group.policy]
                situation = Met(batch.observations, memory.before(batch))
                met[group.policy].append(situation)
                dist_inputs, state = answer(modules[group.policy], situation)
                memory.keep(batch, state)
                drawn = distributions[group.policy]
                if group.explores:
                    raw, _ = drawn.sample(dist_inputs, rng)
                else:
                    raw, _ = drawn.uniform(batch.observations.get(ACTION_MASK), len(situation), rng)
                actions[group] = to_environment(raw, interface.of_policy(group.policy).action)
            turn = batched.step(actions)
    finally:
        batched.close()
    return dict(met)


@_one_thread()
def prove(path: Path, policy: str, module: Acting, batches: list[Met], space: Space) -> Parity:
    """Compare the graph at `path`, as it is served, with `module`, row by row. space: that of the actions.

    Raises ParityError if a greedy action differs that is no near tie, or an input of the distribution, or a number of
    the state, by more than TOLERANCE.
    """
    graph = OnnxPolicy(path)
    near_ties = mismatches = 0
    largest = worst = 0.0
    for situation in batches:
        expected, state = answer(module, situation)
        if not np.isfinite(expected).all():
            raise ParityError(f"policy {policy} has outputs that are not finite: training has diverged")
        mode = module.distribution.mode(torch.from_numpy(expected)).numpy()
        exported = graph.distribution(situation.observations, state=_state_in(situation.state) or None)
        assert exported.dist_inputs is not None
        wrong, tied = differing(exported.actions, to_environment(mode, space), expected, space)
        mismatches, near_ties = mismatches + wrong, near_ties + tied
        largest = max(largest, float(np.abs(exported.dist_inputs - expected).max()))
        pairs = [(exported.dist_inputs, expected)]
        pairs += zip((exported.state or {}).values(), state.values(), strict=True)
        worst = max(worst, *(float((np.abs(found - known) / (1 + np.abs(known))).max()) for found, known in pairs))
    count = sum(map(len, batches))
    if mismatches or not worst <= TOLERANCE:
        raise ParityError(
            f"the graph of policy {policy} differs from its module on {mismatches} of {count} greedy actions, "
            f"and by up to {largest:g} in an input of the distribution"
        )
    return Parity(observations=count, mismatches=mismatches, near_ties=near_ties, max_difference=largest)


def probes(path: Path, batches: list[Met]) -> Probes:
    """Some of the situations, evenly spread over them, with what the graph at `path` does in each."""
    starts = np.cumsum([0, *map(len, batches)])
    size = sum(array[0].nbytes for array in batches[0].observations.values())
    wanted = min(PROBES, max(1, PROBE_BYTES // size), int(starts[-1]))
    rows = np.linspace(0, starts[-1] - 1, wanted).astype(int)
    found = [(batches[i], row - starts[i]) for row in rows for i in [int(np.searchsorted(starts, row, "right")) - 1]]
    observations = {
        name: np.stack([met.observations[name][row] for met, row in found]) for name in batches[0].observations
    }
    state = _state_in({key: np.stack([met.state[key][row] for met, row in found]) for key in batches[0].state})
    return Probes(observations, state, OnnxPolicy(path).act(observations, state=state or None).actions)


def _state_in(state: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """A module's state under the names of the graph's inputs."""
    return dict(zip(state_names(state), state.values(), strict=True))


def answer(module: Acting, situation: Met) -> tuple[NDArray, dict[str, NDArray]]:
    """What a module answers: inputs of its distribution (k, d), and the states after."""
    outputs = module.forward_inference(
        {
            Columns.OBS: {name: torch.from_numpy(array) for name, array in situation.observations.items()},
            Columns.STATE_IN: {key: torch.from_numpy(array) for key, array in situation.state.items()},
        }
    )
    state = {key: value.numpy() for key, value in outputs.get(Columns.STATE_OUT, {}).items()}
    return outputs[Columns.ACTION_DIST_INPUTS].numpy(), state


def _is_enough(met: Mapping[str, list[Met]], interface: Interface, seconds: float) -> bool:
    lacking = {policy: _wanted(met[policy], seconds) - _count(met[policy]) for policy in interface.policy_ids}
    rarest = max(lacking, key=lambda policy: lacking[policy])
    if lacking[rarest] > 0 and seconds > MOST_SECONDS:
        raise ParityError(
            f"policy {rarest} met {_count(met[rarest])} observations in {seconds:.0f} s of play, expected {FEWEST}"
        )
    return lacking[rarest] <= 0


def _wanted(batches: list[Met], seconds: float) -> int:
    if not batches or seconds > ENOUGH_SECONDS:
        return FEWEST
    size = sum(array[0].nbytes for array in batches[0].observations.values())
    return min(OBSERVATIONS, max(FEWEST, MEGABYTES * 2**20 // size))


def _count(batches: list[Met]) -> int:
    return sum(map(len, batches))


def differing(actions: NDArray, expected: NDArray, dist_inputs: NDArray, space: Space) -> tuple[int, int]:
    """Rows whose actions differ, and rows that do so in near ties only."""
    alike, fine = same(actions, expected, space), excused(actions, expected, dist_inputs, space)
    return int((~fine).sum()), int((fine & ~alike).sum())
