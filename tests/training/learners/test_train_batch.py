"""The bootstrap of each way in which a chunk can end, with known values; and recurrent states."""

from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from ray.rllib.core.columns import Columns

from training.learners import train_batch as train_batches
from training.learners.train_batch import (
    Minibatch,
    Sequences,
    TrainBatch,
    generalized_advantages,
    minibatches,
    train_batch,
)
from training.modules.actor_critic import ActorCritic
from training.sampling.episode_chunks import EpisodeChunks

GAMMA, LAMBDA = 0.9, 0.8


def network(space: spaces.Space, **config: Any) -> ActorCritic:
    torch.manual_seed(0)
    return ActorCritic(
        observation_space=spaces.Dict(observation=space),
        action_space=spaces.Discrete(2),
        model_config={"hidden": [4]} | config,
    )


class Identity(ActorCritic):
    """The value of an observation is the observation."""

    def value_step(self, batch: dict[str, Any]) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        return batch[Columns.OBS]["observation"][:, 0].float(), {}


@pytest.fixture
def identity() -> Identity:
    return Identity(
        observation_space=spaces.Dict(observation=spaces.Box(-99, 99, (1,))),
        action_space=spaces.Discrete(2),
        model_config={"hidden": [4]},
    )


def chunk(
    observations: list[Any],
    rewards: list[float],
    states: NDArray | None = None,
    terminated: bool = False,
    truncated: bool = False,
) -> EpisodeChunks:
    n = len(rewards)
    dtype = np.float32 if isinstance(observations[0], float) else np.int64
    column = np.array(observations, dtype)
    return EpisodeChunks(
        name="chunk",
        policy="a",
        agents=np.zeros(1, np.int64),
        started=np.zeros(1, np.int64),
        lengths=np.array([n]),
        observations={"observation": column[:, None] if dtype == np.float32 else column},
        actions=np.arange(n),
        log_p=np.zeros(n, np.float32),
        dist_inputs=np.zeros((n, 2), np.float32),
        state={} if states is None else {"h": states, "c": -states},
        rewards=np.array(rewards, np.float32),
        terminated=np.array([terminated]),
        truncated=np.array([truncated]),
    )


def step_observations(batch: TrainBatch) -> list[float]:
    return batch.observations["observation"][batch.acted].flatten().tolist()


@pytest.mark.parametrize(
    ("end", "target"),
    [({"terminated": True}, 1.0), ({"truncated": True}, 1.0 + GAMMA * 8.0), ({}, 1.0 + GAMMA * 8.0)],
)
def test_the_last_value_is_used_unless_the_agent_terminated(
    identity: Identity, end: dict[str, bool], target: float
) -> None:
    """One-step targets, λ = 0; consecutive chunks are independent."""
    chunks = [chunk([2.0, 4.0, 8.0], [0.0, 1.0], **end), chunk([16.0, 32.0], [3.0])]
    result = train_batch(identity, chunks, gamma=GAMMA, lambda_=0.0)
    assert result.targets.tolist() == pytest.approx([GAMMA * 4.0, target, 3.0 + GAMMA * 32.0])
    assert step_observations(result) == [2.0, 4.0, 16.0]
    assert result.actions.tolist() == [0, 1, 0]


def test_bootstrapping_can_be_configured(identity: Identity) -> None:
    """Like RLlib, which treats truncation as termination."""

    def unless_over(chunks: EpisodeChunks) -> NDArray:
        return ~(chunks.terminated | chunks.truncated)

    chunks = [chunk([2.0, 4.0], [1.0], truncated=True), chunk([2.0, 4.0], [1.0])]
    result = train_batch(identity, chunks, gamma=GAMMA, lambda_=0.0, bootstraps=unless_over)
    assert result.targets.tolist() == pytest.approx([1.0, 1.0 + GAMMA * 4.0])


def test_advantages_are_standardized_and_targets_are_not(identity: Identity) -> None:
    chunks = [chunk([0.0, 1.0, 2.0, 3.0], [1.0, -1.0, 5.0], terminated=True)]
    result = train_batch(identity, chunks, gamma=GAMMA, lambda_=LAMBDA)
    advantages = generalized_advantages(
        np.array([1.0, -1.0, 5.0]), np.arange(3.0), np.array([1.0, 2.0, 0.0]), np.array([0, 0, 1]), GAMMA, LAMBDA
    )
    np.testing.assert_allclose(result.targets, advantages + np.arange(3), rtol=1e-6)
    np.testing.assert_allclose(result.advantages, (advantages - advantages.mean()) / advantages.std(), rtol=1e-5)
    targets = result.targets.numpy()
    assert result.explained_variance == pytest.approx(1 - np.var(targets - np.arange(3)) / np.var(targets))


def test_statistics_are_updated_before_values_are_computed() -> None:
    net = network(spaces.Box(-np.inf, np.inf, (1,)), normalize=True)
    chunks = [chunk([1000.0, 1002.0, 1004.0], [0.0, 0.0])]
    result = train_batch(net, chunks, gamma=1.0, lambda_=1.0)
    normalization = net.encoder.features.parts[0][0]
    assert (float(normalization.count), float(normalization.mean)) == (3, pytest.approx(1002))
    last = net.compute_values({Columns.OBS: {"observation": torch.tensor([[1004.0]])}})
    np.testing.assert_allclose(result.targets, last.detach().repeat(2), rtol=1e-5)


@pytest.mark.parametrize("at_once", [2, 3, 100])
def test_a_recurrent_value_uses_the_state_of_each_step(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared with the module step by step: for γ = 1, λ = 0, no reward, targets are the values of the next steps."""
    monkeypatch.setattr(train_batches, "PASS_ROWS", at_once)
    net = network(spaces.Discrete(5), recurrence=3)
    states = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    chunks = [chunk([0, 1, 2, 3], [0.0] * 3, states[:3], truncated=True), chunk([4, 2, 1], [0.0] * 2, states[3:])]
    result = train_batch(net, chunks, gamma=1.0, lambda_=0.0, sequence=2)

    def value(observation: int, state: dict[str, torch.Tensor]) -> tuple[float, dict[str, torch.Tensor]]:
        batch = {Columns.OBS: {"observation": torch.tensor([observation])}, Columns.STATE_IN: state}
        with torch.no_grad():
            answer, after = net.value_step(batch)
        return answer.item(), after

    def state_before(step: int) -> dict[str, torch.Tensor]:
        return {"h": torch.from_numpy(states[step : step + 1]), "c": torch.from_numpy(-states[step : step + 1])}

    expected = [value(1, state_before(1))[0], value(2, state_before(2))[0], value(3, value(2, state_before(2))[1])[0]]
    expected += [value(2, state_before(4))[0], value(1, value(2, state_before(4))[1])[0]]
    assert result.targets.tolist() == pytest.approx(expected, abs=1e-6)


def test_chunks_are_cut_into_sequences_with_their_first_states() -> None:
    net = network(spaces.Discrete(9), recurrence=1)
    states = np.arange(8, dtype=np.float32)[:, None]
    chunks = [chunk(list(range(6)), [0.0] * 5, states[:5]), chunk([6, 7, 8, 0], [0.0] * 3, states[5:])]
    result = train_batch(net, chunks, gamma=1.0, lambda_=1.0, sequence=3)
    assert result.sequences is not None
    assert result.sequences.starts.tolist() == [0, 3, 5]
    assert result.sequences.lengths.tolist() == [3, 2, 3]
    assert result.units == 3
    minibatch = result.take(torch.tensor([2, 1]))
    assert minibatch.inputs[Columns.OBS]["observation"].tolist() == [6, 7, 8, 3, 4]
    assert minibatch.inputs[Columns.SEQ_LENS].tolist() == [3, 2]
    assert minibatch.inputs[Columns.STATE_IN]["h"].tolist() == [[5.0], [3.0]]
    assert minibatch.actions.tolist() == [0, 1, 2, 3, 4]
    assert len(minibatch.targets) == len(minibatch.advantages) == len(minibatch.log_p) == 5


def test_steps_without_recurrence_are_taken_in_any_order(identity: Identity) -> None:
    result = train_batch(identity, [chunk([2.0, 4.0, 8.0], [0.0, 1.0]), chunk([16.0, 32.0], [3.0])], gamma=1, lambda_=1)
    minibatch = result.take(torch.tensor([2, 0]))
    assert result.units == len(result) == 3
    assert minibatch.inputs[Columns.OBS]["observation"].tolist() == [[16.0], [2.0]]
    assert minibatch.targets.tolist() == result.targets[[2, 0]].tolist()
    assert set(minibatch.inputs) == {Columns.OBS}


def by_recursion(rewards: NDArray, values: NDArray, next_values: NDArray, lasts: NDArray, decay: float) -> list[float]:
    """A_t = δ_t + γλ A_{t+1} (equation 16), step by step."""
    advantages = []
    following = 0.0
    for reward, value, next_value, last in zip(
        *(column[::-1].tolist() for column in (rewards, values, next_values, lasts)), strict=True
    ):
        following = reward + GAMMA * next_value - value + (0.0 if last else decay * following)
        advantages.append(following)
    return advantages[::-1]


@given(st.lists(st.integers(1, 300), min_size=1, max_size=6), st.sampled_from([0.0, LAMBDA, 1.0]), st.integers(0, 9))
def test_advantages_of_chunks_of_any_lengths_equal_the_recursion(lengths: list[int], lambda_: float, seed: int) -> None:
    rewards, values, next_values = np.random.default_rng(seed).normal(size=(3, sum(lengths)))
    lasts = np.isin(np.arange(sum(lengths)), np.cumsum(lengths) - 1)
    advantages = generalized_advantages(rewards, values, next_values, lasts, GAMMA, lambda_)
    expected = by_recursion(rewards, values, next_values, lasts, GAMMA * lambda_)
    np.testing.assert_allclose(advantages, expected, rtol=1e-12, atol=1e-12)


def test_golden_numbers() -> None:
    """Two steps, then truncated with value 2; by hand: δ = (1 + .9·1 − 0, 0 + .9·2 − 1) = (1.9, .8)."""
    advantages = generalized_advantages(
        np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([1.0, 2.0]), np.array([False, True]), GAMMA, LAMBDA
    )
    np.testing.assert_allclose(advantages, [1.9 + 0.72 * 0.8, 0.8])


def batch(steps: int, sequence: int | None = None) -> TrainBatch:
    """Each column is the number of the step."""
    number = torch.arange(steps)
    sequences = None
    if sequence is not None:
        starts = torch.arange(0, steps, sequence)
        lengths = torch.clamp(steps - starts, max=sequence)
        sequences = Sequences(starts, lengths, {"h": starts[:, None].float()})
    return TrainBatch({"observation": number * 10}, number, number, number, number, number, number, sequences, 0.0)


def numbers_of(steps: Minibatch) -> list[int]:
    assert torch.equal(steps.inputs[Columns.OBS]["observation"], steps.actions * 10)
    return steps.actions.tolist()


@given(
    st.dictionaries(st.sampled_from("abc"), st.integers(1, 60), min_size=1),
    st.integers(1, 20),
    st.integers(1, 3),
    st.none() | st.integers(1, 7),
)
@settings(max_examples=60)
def test_each_step_of_each_policy_occurs_once_per_epoch(
    sizes: dict[str, int], size: int, epochs: int, sequence: int | None
) -> None:
    counts: dict[str, Counter[int]] = {policy: Counter() for policy in sizes}
    batches = {policy: batch(steps, sequence) for policy, steps in sizes.items()}
    for minibatch in minibatches(batches, size=size, epochs=epochs):
        for policy, steps in minibatch.items():
            numbers = numbers_of(steps)
            assert 1 <= len(numbers) <= size + (sequence or 1) * -(-size // (sequence or 1))
            counts[policy].update(numbers)
    for policy, steps in sizes.items():
        assert counts[policy] == Counter(dict.fromkeys(range(steps), epochs))


def test_a_small_policy_is_trained_for_the_same_epochs() -> None:
    parts = list(minibatches({"large": batch(400), "small": batch(10)}, size=40, epochs=10))
    sizes = [(len(minibatch["large"].actions), len(minibatch["small"].actions)) for minibatch in parts]
    assert sizes == [(40, 1)] * 100


def test_the_order_differs_between_epochs_and_depends_on_the_seed() -> None:
    orders = []
    for _ in range(2):
        torch.manual_seed(3)
        orders.append([numbers_of(minibatch["a"]) for minibatch in minibatches({"a": batch(50)}, size=50, epochs=2)])
    first, second = orders[0]
    assert first != second
    assert orders[0] == orders[1]


def test_sequences_are_kept_whole_and_shuffled() -> None:
    torch.manual_seed(3)
    starts = []
    for minibatch in minibatches({"a": batch(60, sequence=5)}, size=20, epochs=1):
        steps = minibatch["a"]
        firsts = steps.inputs[Columns.STATE_IN]["h"][:, 0].long().tolist()
        lengths = steps.inputs[Columns.SEQ_LENS].tolist()
        assert len(steps.actions) == 20
        expected = [first + i for first, length in zip(firsts, lengths, strict=True) for i in range(length)]
        assert numbers_of(steps) == expected
        starts += firsts
    assert sorted(starts) == list(range(0, 60, 5)) != starts
