"""Checks on observations from play: a graph acts as the trained module, and on each observation by itself."""

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns

from league.config.environment import EnvironmentConfig
from league.environments.implementation import stock_stepping
from league.environments.stepping import Batch, Indices, Starts
from league.errors import ObservationError, ParityError, one_line
from league.interface import Interface
from league.policies.actions import to_environment
from league.policies.graph_runs import open_session
from league.policies.onnx import LAST_ACTION, OnnxPolicy
from league.policies.probes import Probes, excused, same
from league.random.seeds import derive, generator
from league.registry.storage.manifest import Parity
from league.spaces import ACTION_MASK, Discrete, Space
from league.spaces.arrays import tensors
from league.spaces.conversion import to_gymnasium
from training.export.onnx_export import state_names
from training.modules.actor_critic import ActorCritic
from training.modules.policy_module import PolicyModule
from training.modules.value_function import ReturnNormalization
from training.sampling.distributions import distribution
from training.sampling.env_runner import one_thread
from training.sampling.recurrent_state import RecurrentStates
from training.sampling.reset_seeds import SEEDS

MIN_OBSERVATIONS = 256
NUM_ENVS = 8
TOLERANCE = 1e-3
"""Maximum difference of distribution inputs and states, relative to 1 + |x|: above it, exploration would differ."""
PROBES, MAX_PROBE_BYTES = 32, 2**20
"""Probes recorded per policy; fewer if their observations exceed this size."""
ROWS, MAX_ROW_BYTES = 256, 32 * 2**20
"""Observations on which `check_rows` runs a graph, likewise."""

BY_CHANCE = "as with Dropout or BatchNorm in training mode: export the network in evaluation mode"


@dataclass(frozen=True, slots=True)
class PlayLimits:
    """How much is played for a check.

    Attributes:
        observations: Of each policy.
        megabytes: Large observations are limited to this size, but not below `least`.
        enough_seconds: Seconds of play after which `least` observations suffice.
        most_seconds: Seconds after which a policy with fewer has failed.
        least: Observations that are required.
    """

    observations: int
    megabytes: int
    enough_seconds: float
    most_seconds: float
    least: int = MIN_OBSERVATIONS


EXPORTED = PlayLimits(observations=2048, megabytes=128, enough_seconds=8.0, most_seconds=120.0)


@dataclass(frozen=True, slots=True)
class ObservedBatch:
    """k observations of a policy, and the recurrent states before them.

    observations: ONNX input name → (k, …). state: key → (k, width), with the keys of the module or of an imported
    graph; empty if not recurrent.
    """

    observations: dict[str, NDArray]
    state: dict[str, NDArray]

    def __len__(self) -> int:
        return len(next(iter(self.observations.values())))


Acting = Callable[[str, ObservedBatch, bool], tuple[NDArray, Mapping[str, NDArray]]]
"""Policy id, its observations, and whether it plays or random actions are taken → actions in the environment's space,
and the states after."""


def observed_play(
    environment: EnvironmentConfig,
    interface: Interface,
    initial_states: Mapping[str, Mapping[str, NDArray]],
    act: Acting,
    limits: PlayLimits,
    seeds: Iterator[int],
) -> dict[str, list[ObservedBatch]]:
    """Play until each policy has enough observations; return policy → batches of them, with recurrent states.

    For a game that runs in simulators, which may be busy with training, observations are drawn from their spaces.
    In every other environment the policies play, in the rest random actions are taken, to include observations that the
    policies do and do not reach.

    Args:
        environment: Played in NUM_ENVS stock environments.
        interface: Of the environment.
        initial_states: Policy id → key → (width,); empty if not recurrent.
        act: Chooses the actions.
        limits: How much is played.
        seeds: Of the episodes.

    Raises:
        ParityError: A policy does not act often enough. What `act` raises.
    """
    if environment.external is not None:
        return _drawn(interface, initial_states, act, limits, next(seeds))
    policies = interface.policy_ids
    batches: dict[str, list[ObservedBatch]] = {policy: [] for policy in policies}
    began = time.monotonic()
    with closing(stock_stepping(environment, NUM_ENVS)) as batched:
        # Group 2 i is policy i at random, group 2 i + 1 the policy itself.
        groups = 2 * np.array([policies.index(interface.policies[agent]) for agent in batched.agents])
        recurrent_states = {
            policy: RecurrentStates(state, NUM_ENVS, len(batched.agents)) for policy, state in initial_states.items()
        }

        def next_episodes(envs: Indices) -> Starts:
            return Starts(envs, np.array([next(seeds) for _ in envs]), groups + envs[:, np.newaxis] % 2)

        turn = batched.start(next_episodes)
        while not _is_enough(batches, limits, time.monotonic() - began):
            for states in recurrent_states.values():
                states.forget(turn.finished)
            actions = {}
            for group, batch in turn.batches.items():
                policy = policies[group // 2]
                observed = ObservedBatch(batch.observations, recurrent_states[policy].get(batch))
                batches[policy].append(observed)
                actions[group], after = act(policy, observed, bool(group % 2))
                recurrent_states[policy].update(batch, after)
            turn = batched.step(actions)
    return batches


def _drawn(
    interface: Interface,
    initial_states: Mapping[str, Mapping[str, NDArray]],
    act: Acting,
    limits: PlayLimits,
    seed: int,
) -> dict[str, list[ObservedBatch]]:
    """Return observations drawn uniformly from each policy's space, in sequences with its recurrent states."""
    rng = generator(seed, "drawn")
    batches: dict[str, list[ObservedBatch]] = {}
    for policy in interface.policy_ids:
        spaces = interface.of_policy(policy)
        space = to_gymnasium(spaces.observation)
        space.seed(int(rng.integers(2**31)))
        states = RecurrentStates(initial_states[policy], NUM_ENVS, 1)
        envs, agents = np.arange(NUM_ENVS), np.zeros(NUM_ENVS, np.int64)
        batches[policy] = []
        for _ in range(math.ceil(limits.least / NUM_ENVS)):
            rows = [tensors(spaces.observation, space.sample()) for _ in range(NUM_ENVS)]
            arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
            if (mask := arrays.get(ACTION_MASK)) is not None:
                mask[:] = not isinstance(spaces.action, Discrete) or rng.random(mask.shape) < 0.5
                mask[envs, rng.integers(mask.shape[1], size=NUM_ENVS)] = 1
            batch = Batch(envs, agents, arrays, np.zeros(NUM_ENVS))
            observed = ObservedBatch(arrays, states.get(batch))
            batches[policy].append(observed)
            _, after = act(policy, observed, True)
            states.update(batch, after)
    return batches


def _is_enough(batches: Mapping[str, list[ObservedBatch]], limits: PlayLimits, seconds: float) -> bool:
    counts = {policy: sum(map(len, observed)) for policy, observed in batches.items()}
    if seconds > limits.most_seconds and (count := min(counts.values())) < limits.least:
        rarest = min(counts, key=lambda policy: counts[policy])
        raise ParityError(
            f"policy {rarest} received {count} observations in {seconds:.0f} s of play, expected {limits.least}"
        )
    for policy, observed in batches.items():
        target = limits.least
        if observed and seconds <= limits.enough_seconds:
            size = sum(array[0].nbytes for array in observed[0].observations.values())
            target = min(limits.observations, max(limits.least, limits.megabytes * 2**20 // size))
        if counts[policy] < target:
            return False
    return True


@one_thread()
def collect_observations(
    environment: EnvironmentConfig, interface: Interface, modules: Mapping[str, PolicyModule], seed: int
) -> dict[str, list[ObservedBatch]]:
    """Return what `observed_play` returns, where modules sample from their distributions. Raises ParityError."""
    rng = generator(seed, "parity")
    actions = {policy: interface.of_policy(policy).action for policy in modules}
    distributions = {policy: distribution(space) for policy, space in actions.items()}

    def act(policy: str, observed: ObservedBatch, plays: bool) -> tuple[NDArray, Mapping[str, NDArray]]:
        dist_inputs, state = module_outputs(modules[policy], observed)
        if plays:
            raw, _ = distributions[policy].sample(dist_inputs, rng)
        else:
            raw, _ = distributions[policy].uniform(observed.observations.get(ACTION_MASK), len(observed), rng)
        return to_environment(raw, actions[policy]), state

    initial_states = {policy: module.get_initial_state() for policy, module in modules.items()}
    seeds = (derive(seed, "parity", reset) % SEEDS for reset in itertools.count())
    return observed_play(environment, interface, initial_states, act, EXPORTED, seeds)


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


@one_thread()
def check_value(
    path: Path, policy: str, module: ActorCritic, scale: ReturnNormalization | None, batches: list[ObservedBatch]
) -> None:
    """Compare the value graph at `path` with `module`, whose values have the units `scale`.

    Raises ParityError if a distribution input or a value differs by more than TOLERANCE, or depends on more than the
    observation.
    """
    session, worst = open_session(path.read_bytes()), 0.0
    if problem := influence(lambda arrays: session.run(None, arrays), _sampled(batches, ROWS, MAX_ROW_BYTES)[0]):
        raise ParityError(f"the value graph of policy {policy} {problem}")
    for batch in batches:
        observations = {name: torch.from_numpy(array) for name, array in batch.observations.items()}
        with torch.no_grad():
            outputs = module.train_outputs(module.encoder(observations), observations)
        values = outputs[Columns.VF_PREDS].numpy()
        expected = outputs[Columns.ACTION_DIST_INPUTS].numpy(), values if scale is None else scale.denormalized(values)
        for exported, module_output in zip(session.run(None, batch.observations), expected, strict=True):
            worst = max(worst, float((np.abs(exported - module_output) / (1 + np.abs(module_output))).max()))
    if not worst <= TOLERANCE:
        raise ParityError(
            f"the value graph of policy {policy} differs from its module by {worst:g}, relative to 1 + |x|"
        )


@one_thread()
def check_rows(policy: str, graph: OnnxPolicy, batches: list[ObservedBatch], space: Space) -> None:
    """Raise ParityError if what a graph computes for an observation depends on anything else.

    It would play one game in the batches of a match and another alone. A comparison with its source does not show this,
    since the source has the same defect. space: of the actions.
    """
    observations, state = _sampled(batches, ROWS, MAX_ROW_BYTES)

    def run(arrays: Mapping[str, NDArray]) -> list[NDArray]:
        answer = graph.outputs(arrays, state={name: arrays[name] for name in state} or None)
        assert answer.dist_inputs is not None
        # The previous action in a state is the greedy one.
        after = [array for name, array in (answer.state or {}).items() if name != LAST_ACTION]
        return [answer.actions, answer.dist_inputs, *after]

    if problem := influence(run, observations | state, space):
        raise ParityError(f"the graph of policy {policy} {problem}")


def influence(
    run: Callable[[Mapping[str, NDArray]], Sequence[NDArray]], arrays: Mapping[str, NDArray], space: Space | None = None
) -> str | None:
    """Return how other rows or chance influence the outputs of a graph for a row, a predicate; None if they do not.

    A batch is run, run again, in another order, and row by row. Outputs differ if they do by more than TOLERANCE, and
    greedy actions if they do other than in near ties.

    Args:
        run: Inputs of the graph, each (k, …) → outputs, each (k, …).
        arrays: Inputs for k rows.
        space: Of the actions, if the first outputs are greedy actions and distribution inputs.
    """
    rows = len(next(iter(arrays.values())))
    backwards = np.arange(rows)[::-1]
    together, again = run(arrays), run(arrays)
    reversed_rows = run({name: array[backwards] for name, array in arrays.items()})
    try:
        single = [run({name: array[row : row + 1] for name, array in arrays.items()}) for row in range(rows)]
        alone = [np.concatenate(outputs) for outputs in zip(*single, strict=True)]
        if shapes := [output.shape for output in alone if len(output) != rows]:
            raise ValueError(f"{rows} single runs have an output of the shape {list(shapes[0])}")
    except (ObservationError, ValueError) as error:
        return f"fails on a single observation: {one_line(error)}"
    cause = (
        "its rows influence each other, as with a softmax, statistics or dynamic quantization over axis 0, or with"
        " attention or recurrence that take axis 0 for time (batch_first)"
    )
    for outputs, where, reason in (
        (again, "in a second run", BY_CHANCE),
        (alone, "alone than in a batch", cause),
        ([output[backwards] for output in reversed_rows], "in another order", cause),
    ):
        differs = np.zeros(rows, bool)
        for number, (output, expected) in enumerate(zip(outputs, together, strict=True)):
            if space is not None and number == 0:
                differs |= ~excused(output, expected, together[1], space)
            else:
                close = np.isclose(output, expected, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
                differs |= ~close.reshape(rows, -1).all(axis=1)
        if differs.any():
            return f"computes other outputs for {differs.sum()} of {rows} observations {where}: {reason}"
    return None


def probes(graph: OnnxPolicy, batches: list[ObservedBatch]) -> Probes:
    """Return evenly spaced observations with the actions of a graph."""
    observations, state = _sampled(batches, PROBES, MAX_PROBE_BYTES)
    return Probes(observations, state, graph.act(observations, state=state or None).actions)


def _sampled(batches: list[ObservedBatch], most: int, most_bytes: int) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """Return evenly spaced observations, and the graph's states before them."""
    starts = np.cumsum([0, *map(len, batches)])
    size = sum(array[0].nbytes for array in batches[0].observations.values())
    count = min(most, max(1, most_bytes // size), int(starts[-1]))
    rows = np.linspace(0, starts[-1] - 1, count).astype(int)
    samples = [(batches[i], row - starts[i]) for row in rows for i in [int(np.searchsorted(starts, row, "right")) - 1]]
    observations = {
        name: np.stack([batch.observations[name][row] for batch, row in samples]) for name in batches[0].observations
    }
    state = {key: np.stack([batch.state[key][row] for batch, row in samples]) for key in batches[0].state}
    return observations, _state_in(state)


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


def count_differences(actions: NDArray, expected: NDArray, dist_inputs: NDArray, space: Space) -> tuple[int, int]:
    """Return the number of rows whose actions differ, and of those that differ in near ties only."""
    alike, fine = same(actions, expected, space), excused(actions, expected, dist_inputs, space)
    return int((~fine).sum()), int((fine & ~alike).sum())
