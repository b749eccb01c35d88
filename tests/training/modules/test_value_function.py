"""The scale of returns."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from training.modules.value_function import ReturnNormalization

RETURNS = arrays(np.float64, st.integers(2, 20), elements=st.floats(-1e4, 1e4))


@given(st.lists(RETURNS, min_size=1, max_size=3))
def test_units_are_the_mean_and_deviation_of_all_returns(batches: list[np.ndarray]) -> None:
    scale = ReturnNormalization()
    for batch in batches:
        scale.update(torch.from_numpy(batch))
    together = np.concatenate(batches)
    np.testing.assert_allclose(scale.denormalized(np.zeros(1)), together.mean(), atol=1e-6)
    np.testing.assert_allclose(scale.deviation, np.sqrt(together.var() + 1e-8), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(scale.denormalized(scale.normalized(together)), together, atol=1e-6)


def test_before_the_first_returns_units_are_those_of_returns() -> None:
    assert ReturnNormalization().denormalized(np.array([3.0])) == pytest.approx(3.0)


def test_rare_returns_are_not_clipped() -> None:
    scale = ReturnNormalization()
    scale.update(torch.tensor([0.0] * 999 + [1000.0]))
    assert scale.normalized(np.array([1000.0]))[0] == pytest.approx(31.6, abs=0.1)
