"""Checks of an imported policy on observations from play: legality, finiteness, and parity with its source."""

import itertools
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.lockstep import stock_stepping
from league.environments.stepping import Indices, Starts, legal_rows
from league.errors import ParityError
from league.interface import AgentInterface, Interface
from league.policies.onnx import OnnxPolicy
from league.policies.probes import Probes, excused, same
from league.policies.scripted import Random
from league.random.seeds import derive, generator
from league.registry.storage.manifest import Parity
from league.spaces import ACTION_MASK, DictSpace
from training.importing.source import Original, State, known_logits
from training.sampling.recurrent_state import RecurrentStates
from training.sampling.reset_seeds import SEEDS

TARGET_OBSERVATIONS = 10_000
"""Observations per policy for the comparison."""
MIN_OBSERVATIONS = 256
MAX_MEGABYTES = 256
"""Large observations are limited to this size, but not below MIN_OBSERVATIONS."""
ENOUGH_SECONDS, MOST_SECONDS = 300.0, 600.0
"""Seconds of play after which MIN_OBSERVATIONS suffice, and after which a policy with fewer has failed."""
NUM_ENVS = 8
PROBES, MAX_PROBE_BYTES = 32, 2**20


@dataclass(frozen=True, slots=True)
class PlayedBatch:
    """k observations of a policy from play, with the states before them.

    observations: ONNX input name → (k, …). state: of the imported graph; empty if it is not recurrent.
    """

    observations: dict[str, NDArray]
    state: State

    def __len__(self) -> int:
        return len(next(iter(self.observations.values())))


def collect(
    environment: EnvironmentConfig, interface: Interface, policies: Mapping[str, OnnxPolicy], seed: int
) -> dict[str, list[PlayedBatch]]:
    """Play until each policy has enough observations, half of the environments at random, half with the policies.

    Raises ParityError if a policy does not act often enough or acts illegally.
    """
    batched, resets, names = stock_stepping(environment, NUM_ENVS), itertools.count(), interface.policy_ids
    groups = 2 * np.array([names.index(interface.policies[agent]) for agent in batched.agents])
    spaces = {name: interface.of_policy(name) for name in names}
    scripts = {name: Random(policy_spaces.observation, policy_spaces.action) for name, policy_spaces in spaces.items()}
    recurrent = {
        name: RecurrentStates(
            {key: rows[0] for key, rows in policy.initial_state(1).items()}, NUM_ENVS, len(batched.agents)
        )
        for name, policy in policies.items()
    }
    rng, batches, began = generator(seed, "import"), defaultdict[str, list[PlayedBatch]](list), time.monotonic()

    def next_episodes(envs: Indices) -> Starts:
        seeds = [derive(seed, "import", next(resets)) % SEEDS for _ in envs]
        return Starts(envs, np.array(seeds), groups + envs[:, np.newaxis] % 2)

    try:
        turn = batched.start(next_episodes)
        while not _is_enough(batches, names, time.monotonic() - began):
            for states in recurrent.values():
                states.forget(turn.finished)
            actions = {}
            for group, batch in turn.batches.items():
                name, plays = names[group // 2], group % 2
                played = PlayedBatch(batch.observations, recurrent[name].get(batch))
                batches[name].append(played)
                answer = policies[name].act(played.observations, state=played.state or None)
                recurrent[name].update(batch, answer.state or {})
                _check_legal(name, answer.actions, spaces[name], played)
                drawn = scripts[name].act(played.observations, rng=[rng] * len(played))
                actions[group] = answer.actions if plays else drawn.actions
            turn = batched.step(actions)
    finally:
        batched.close()
    return dict(batches)


def check_parity(
    policy: str, graph: OnnxPolicy, original: Original, batches: list[PlayedBatch], spaces: AgentInterface
) -> Parity:
    """Compare the greedy actions of the imported graph with those of its source.

    Raises ParityError if one differs other than in a near tie, or if an output is not finite.
    """
    action = spaces.action
    assert not isinstance(action, DictSpace)
    mismatches = near_ties = 0
    largest = 0.0
    for played in batches:
        answer = graph.distribution(played.observations, state=played.state or None)
        assert answer.dist_inputs is not None
        if not np.isfinite(answer.dist_inputs).all():
            raise ParityError(f"policy {policy}: the graph has outputs that are not finite")
        state = dict(zip(original.initial_state(1), played.state.values(), strict=True))
        expected, logits, after = original.act(played.observations, state)
        alike = same(answer.actions, expected, action)
        fine = excused(answer.actions, expected, known_logits(logits, expected, spaces), action)
        mismatches += int((~fine).sum())
        near_ties += int((fine & ~alike).sum())
        for graph_state, source_state in zip((answer.state or {}).values(), after.values(), strict=True):
            largest = max(largest, float(np.abs(graph_state - source_state).max()))
    count = sum(map(len, batches))
    if mismatches:
        raise ParityError(f"policy {policy}: {mismatches} of {count} greedy actions differ from those of the source")
    return Parity(observations=count, mismatches=0, near_ties=near_ties, max_difference=largest)


def probes(graph: OnnxPolicy, batches: list[PlayedBatch]) -> Probes:
    """Return evenly spaced observations with the actions of the graph."""
    first = batches[0]
    together = {name: np.concatenate([batch.observations[name] for batch in batches]) for name in first.observations}
    states = {name: np.concatenate([batch.state[name] for batch in batches]) for name in first.state}
    total = len(next(iter(together.values())))
    size = sum(array[0].nbytes for array in together.values())
    rows = np.linspace(0, total - 1, min(PROBES, max(1, MAX_PROBE_BYTES // size), total)).astype(int)
    observations = {name: array[rows] for name, array in together.items()}
    state = {name: array[rows] for name, array in states.items()}
    return Probes(observations, state, graph.act(observations, state=state or None).actions)


def _check_legal(policy: str, actions: NDArray, spaces: AgentInterface, played: PlayedBatch) -> None:
    mask = played.observations.get(ACTION_MASK)
    if not (legal := legal_rows(actions, spaces.action, mask)).all():
        row = int(np.flatnonzero(~legal)[0])
        allowed = "" if mask is None else f", where action_mask is {mask[row].tolist()}"
        raise ParityError(f"policy {policy}: action {actions[row].tolist()} is illegal{allowed}")


def _is_enough(found: Mapping[str, list[PlayedBatch]], policies: Sequence[str], seconds: float) -> bool:
    for policy in policies:
        batches = found.get(policy, [])
        count = sum(map(len, batches))
        if count < _wanted(batches, seconds):
            if seconds > MOST_SECONDS:
                raise ParityError(
                    f"policy {policy} received {count} observations in {seconds:.0f} s of play, "
                    f"expected {MIN_OBSERVATIONS}"
                )
            return False
    return True


def _wanted(batches: list[PlayedBatch], seconds: float) -> int:
    if not batches or seconds > ENOUGH_SECONDS:
        return MIN_OBSERVATIONS
    size = sum(array[0].nbytes for array in batches[0].observations.values())
    return min(TARGET_OBSERVATIONS, max(MIN_OBSERVATIONS, MAX_MEGABYTES * 2**20 // size))
