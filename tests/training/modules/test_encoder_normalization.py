import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from training.modules.encoder import MAX_DEVIATIONS, RunningNormalization


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=5), st.floats(-1e4, 1e4), st.floats(1e-2, 1e3), st.integers(0, 9)
)
@settings(deadline=None, max_examples=50)
def test_statistics_of_batches_equal_those_of_all_values(
    sizes: list[int], mean: float, deviation: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    batches = [random.normal(mean, deviation, (size, 3)) for size in sizes]
    normalization = RunningNormalization((3,))
    for batch in batches:
        normalization.update(torch.from_numpy(batch))
    everything = np.concatenate(batches)
    assert float(normalization.count) == len(everything)
    np.testing.assert_allclose(normalization.mean, everything.mean(0), rtol=1e-9, atol=1e-9 * deviation)
    np.testing.assert_allclose(normalization.variance, everything.var(0), rtol=1e-6, atol=1e-9 * deviation**2)


def test_rows_that_are_not_counted_do_not_affect_the_statistics() -> None:
    values, counted = torch.randn(9, 2, 3), torch.arange(9) % 3 > 0
    selected, masked = RunningNormalization((2, 3)), RunningNormalization((2, 3))
    for factor in (1, 5):
        selected.update(factor * values[counted])
        masked.update(torch.where(counted.view(-1, 1, 1), factor * values, 1e6), counted)
    masked.update(values, torch.zeros(9, dtype=torch.bool))
    torch.testing.assert_close(dict(masked.named_buffers()), dict(selected.named_buffers()))


def test_values_are_shifted_scaled_and_clipped() -> None:
    normalization = RunningNormalization((2,))
    values = torch.tensor([[3.0, -50.0], [1e9, 2.0]])
    # Before the first update, values are only clipped.
    torch.testing.assert_close(normalization(values), torch.tensor([[3.0, -MAX_DEVIATIONS], [MAX_DEVIATIONS, 2.0]]))
    normalization.update(torch.tensor([[1.0, 10.0], [3.0, 10.0]]))
    scaled = normalization(torch.tensor([[3.0, 10.0], [1.5, 10.1]]))
    assert torch.allclose(scaled, torch.tensor([[1.0, 0.0], [-0.5, MAX_DEVIATIONS]]), atol=1e-5), (
        "a constant is not scaled"
    )


def test_statistics_are_part_of_the_weights() -> None:
    first, second = RunningNormalization((2,)), RunningNormalization((2,))
    first.update(torch.randn(9, 2))
    second.load_state_dict(first.state_dict())
    for normalization in (first, second):
        normalization.update(torch.ones(4, 2))
    assert torch.equal(first.mean, second.mean)
    assert torch.equal(first.variance, second.variance)
