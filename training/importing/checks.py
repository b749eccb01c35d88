"""Checks of an imported policy on observations from play: legality, finiteness, and parity with its source."""

import itertools
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.stepping import legal_rows
from league.errors import ParityError
from league.interface import AgentInterface, Interface
from league.policies.draws import elements
from league.policies.onnx import OnnxPolicy
from league.policies.probes import excused, same
from league.policies.scripted import Random
from league.random.seeds import derive, generator
from league.registry.storage.manifest import Parity
from league.spaces import ACTION_MASK, DictSpace, Leaf, MultiDiscrete
from training.export.parity import BY_CHANCE, ObservedBatch, PlayLimits, observed_play
from training.importing.source import Source, known_logits
from training.sampling.reset_seeds import SEEDS

IMPORTED = PlayLimits(observations=10_000, megabytes=256, enough_seconds=300.0, most_seconds=600.0)

ROUNDED = 1e-3
"""Maximum difference of a sum of probabilities from 1: models may compute with half precision."""


def collect(
    environment: EnvironmentConfig, interface: Interface, policies: Mapping[str, OnnxPolicy], seed: int
) -> dict[str, list[ObservedBatch]]:
    """Return what `observed_play` returns, where the imported graphs play greedily.

    Raises ParityError if a policy does not act often enough or acts illegally.
    """
    spaces = {policy: interface.of_policy(policy) for policy in policies}
    scripts = {policy: Random(agent.observation, agent.action) for policy, agent in spaces.items()}
    rng = generator(seed, "import")

    def act(policy: str, observed: ObservedBatch, plays: bool) -> tuple[NDArray, Mapping[str, NDArray]]:
        answer = policies[policy].act(observed.observations, state=observed.state or None)
        mask = observed.observations.get(ACTION_MASK)
        if not (legal := legal_rows(answer.actions, spaces[policy].action, mask)).all():
            row = int(np.flatnonzero(~legal)[0])
            allowed = "" if mask is None else f", where action_mask is {mask[row].tolist()}"
            raise ParityError(f"policy {policy}: action {answer.actions[row].tolist()} is illegal{allowed}")
        drawn = answer if plays else scripts[policy].act(observed.observations, rng=[rng] * len(observed))
        return drawn.actions, answer.state or {}

    initial_states = {
        policy: {key: rows[0] for key, rows in graph.initial_state(1).items()} for policy, graph in policies.items()
    }
    seeds = (derive(seed, "import", reset) % SEEDS for reset in itertools.count())
    return observed_play(environment, interface, initial_states, act, IMPORTED, seeds)


def check_parity(
    policy: str, graph: OnnxPolicy, source: Source, batches: list[ObservedBatch], spaces: AgentInterface
) -> Parity:
    """Compare the greedy actions of the imported graph with those of its source.

    Raises ParityError if one differs other than in a near tie, if an output is not finite, or if probabilities would be
    taken for logits or the other way round.
    """
    action, original, kind = spaces.action, source.original, source.mapping.kind
    assert not isinstance(action, DictSpace)
    mismatches = near_ties = probabilities = 0
    largest = 0.0
    for played in batches:
        answer = graph.distribution(played.observations, state=played.state or None)
        assert answer.dist_inputs is not None
        if not np.isfinite(answer.dist_inputs).all():
            raise ParityError(f"policy {policy}: the graph has outputs that are not finite")
        state = dict(zip(original.initial_state(1), played.state.values(), strict=True))
        expected, logits, after = original.act(played.observations, state)
        if logits is not None:
            probabilities += int(
                _are_probabilities(np.exp(logits) if kind == "probabilities" else logits, action).sum()
            )
        alike = same(answer.actions, expected, action)
        fine = excused(answer.actions, expected, known_logits(logits, expected, spaces), action)
        if not fine.all() and not same(original.act(played.observations, state)[0], expected, action).all():
            raise ParityError(f"policy {policy}: greedy actions of the source differ from run to run, {BY_CHANCE}")
        mismatches += int((~fine).sum())
        near_ties += int((fine & ~alike).sum())
        for graph_state, source_state in zip((answer.state or {}).values(), after.values(), strict=True):
            largest = max(largest, float(np.abs(graph_state - source_state).max()))
    count = sum(map(len, batches))
    if kind == "probabilities" and probabilities < count:
        raise ParityError(
            f"policy {policy}: for {count - probabilities} of {count} observations, {source.mapping.output} is not"
            " probabilities: expected numbers from 0 to 1 with the sum 1"
        )
    if kind == "logits" and source.inferred and probabilities == count:
        raise ParityError(
            f"policy {policy}: for all {count} observations, the numbers of {source.mapping.output} are from 0 to 1"
            " with the sum 1. As logits they would make sampled play almost uniform: write a mapping file with"
            " `kind: probabilities`, or with `kind: logits` if they are logits"
        )
    if mismatches:
        raise ParityError(f"policy {policy}: {mismatches} of {count} greedy actions differ from those of the source")
    return Parity(observations=count, mismatches=0, near_ties=near_ties, max_difference=largest)


def _are_probabilities(values: NDArray, action: Leaf) -> NDArray[np.bool_]:
    """Return whether each row of numbers, (k, d), is a distribution of each element of an action, (k,) bool."""
    sums = [part.sum(axis=1) for part in (elements(values, action) if isinstance(action, MultiDiscrete) else [values])]
    return (values >= 0).all(axis=1) & (np.abs(np.stack(sums, axis=1) - 1) <= ROUNDED).all(axis=1)
