from collections import Counter

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch

from training.learners.minibatches import Minibatches


def batch(sizes: dict[str, int]) -> MultiAgentBatch:
    rows = {
        policy: SampleBatch({"row": torch.arange(size), "obs": {"observation": torch.arange(size) * 10}})
        for policy, size in sizes.items()
    }
    return MultiAgentBatch(rows, env_steps=sum(sizes.values()))


@given(
    st.dictionaries(st.sampled_from("abc"), st.integers(1, 60), min_size=1),
    st.integers(1, 20),
    st.integers(1, 3),
)
@settings(max_examples=50, deadline=None)
def test_each_row_of_each_policy_once_per_epoch(sizes: dict[str, int], minibatch_size: int, epochs: int) -> None:
    seen: dict[str, Counter[int]] = {policy: Counter() for policy in sizes}
    for minibatch in Minibatches(batch(sizes), minibatch_size=minibatch_size, num_epochs=epochs):
        for policy, rows in minibatch.policy_batches.items():
            assert 1 <= len(rows) <= minibatch_size
            assert torch.equal(rows["obs"]["observation"], rows["row"] * 10)
            seen[policy].update(rows["row"].tolist())
    for policy, size in sizes.items():
        assert seen[policy] == Counter(dict.fromkeys(range(size), epochs))


def test_a_small_policy_is_not_trained_on_more_often() -> None:
    minibatches = list(Minibatches(batch({"large": 4000, "small": 100}), minibatch_size=400, num_epochs=10))
    assert len(minibatches) == 100
    assert all(len(minibatch.policy_batches["small"]) == 10 for minibatch in minibatches)


def test_the_order_differs_between_epochs() -> None:
    minibatches = Minibatches(batch({"a": 50}), minibatch_size=50, num_epochs=2)
    first, second = (minibatch.policy_batches["a"]["row"].tolist() for minibatch in minibatches)
    assert first != second
