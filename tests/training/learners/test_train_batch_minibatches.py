from collections import Counter

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from ray.rllib.core.columns import Columns

from training.learners.train_batch import Minibatch, Sequences, TrainBatch, minibatches


def batch(steps: int, sequence: int | None = None) -> TrainBatch:
    """Each column is the number of the step."""
    number = torch.arange(steps)
    sequences = None
    if sequence is not None:
        starts = torch.arange(0, steps, sequence)
        lengths = torch.clamp(steps - starts, max=sequence)
        sequences = Sequences(starts, lengths, {"h": starts[:, None].float()})
    return TrainBatch({"observation": number * 10}, number, number, number, number, number, number, sequences, 0.0)


def numbers(steps: Minibatch) -> list[int]:
    assert torch.equal(steps.inputs[Columns.OBS]["observation"], steps.actions * 10)
    return steps.actions.tolist()


@given(
    st.dictionaries(st.sampled_from("abc"), st.integers(1, 60), min_size=1),
    st.integers(1, 20),
    st.integers(1, 3),
    st.none() | st.integers(1, 7),
)
@settings(max_examples=60, deadline=None)
def test_each_step_of_each_policy_occurs_once_per_epoch(
    sizes: dict[str, int], size: int, epochs: int, sequence: int | None
) -> None:
    seen: dict[str, Counter[int]] = {policy: Counter() for policy in sizes}
    batches = {policy: batch(steps, sequence) for policy, steps in sizes.items()}
    for minibatch in minibatches(batches, size=size, epochs=epochs):
        for policy, steps in minibatch.items():
            taken = numbers(steps)
            assert 1 <= len(taken) <= size + (sequence or 1) * -(-size // (sequence or 1))
            seen[policy].update(taken)
    for policy, steps in sizes.items():
        assert seen[policy] == Counter(dict.fromkeys(range(steps), epochs))


def test_a_small_policy_is_trained_for_the_same_epochs() -> None:
    found = list(minibatches({"large": batch(4000), "small": batch(100)}, size=400, epochs=10))
    assert len(found) == 100
    assert all(len(minibatch["small"].actions) == 10 for minibatch in found)
    assert all(len(minibatch["large"].actions) == 400 for minibatch in found)


def test_the_order_differs_between_epochs_and_depends_on_the_seed() -> None:
    orders = []
    for _ in range(2):
        torch.manual_seed(3)
        orders.append([numbers(minibatch["a"]) for minibatch in minibatches({"a": batch(50)}, size=50, epochs=2)])
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
        assert numbers(steps) == expected
        starts += firsts
    assert sorted(starts) == list(range(0, 60, 5)) != starts
