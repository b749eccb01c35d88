import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from league.config.network import Channels, channels_of
from league.errors import ConfigError
from training.modules.encoder import MAX_DEVIATIONS, ObservationFeatures, RunningNormalization

PLANES = spaces.Box(0, 1, (6, 7, 2), np.int8)


def test_features_of_all_leaves() -> None:
    """Parts are in the order of their names; integers are one-hot from their start; masks are omitted."""
    features = ObservationFeatures(
        spaces.Dict(
            {
                "action_mask": spaces.Box(0, 1, (9,), np.int8),
                "observation.box": spaces.Box(-1, 1, (2,), np.float64),
                "observation.die": spaces.Discrete(3, start=1),
                "observation.flag": spaces.Box(0, 1, (1, 1), np.bool_),
                "observation.pair": spaces.MultiDiscrete([2, 3], start=[5, 0]),
                "observation.switches": spaces.MultiBinary(2),
            }
        )
    )
    row = features(
        {
            "observation.box": torch.tensor([[0.5, -0.5]], dtype=torch.float64),
            "observation.die": torch.tensor([3]),
            "observation.flag": torch.tensor([[[True]]]),
            "observation.pair": torch.tensor([[6, 2]]),
            "observation.switches": torch.tensor([[1, 0]], dtype=torch.int8),
        }
    )
    assert features.width == 13
    assert row.dtype == torch.float32
    assert row[0].tolist() == pytest.approx([0.5, -0.5, 0, 0, 1, 1, 0, 1, 0, 0, 1, 1, 0])


def test_finite_bounds_are_scaled(subtests: pytest.Subtests) -> None:
    rows: list[tuple[spaces.Box, list[float], list[float]]] = [
        (spaces.Box(0, 255, (2,), np.uint8), [0, 255], [0, 1]),
        (spaces.Box(-200, 200, (2,), np.float32), [-200, 100], [0, 0.75]),
        (spaces.Box(np.array([0, 100]), np.array([100, 300]), dtype=np.int64), [25, 200], [0.25, 0.5]),
        (spaces.Box(0, 30, (2,), np.float32), [3, 30], [3, 30]),
        (spaces.Box(-3e38, 3e38, (2,), np.float32), [3, -30], [3, -30]),
        (spaces.Box(0, np.inf, (2,), np.float32), [300, 0], [300, 0]),
        (spaces.Box(np.array([0, 0]), np.array([255, 1]), dtype=np.int64), [51, 1], [51, 1]),
    ]
    for space, value, expected in rows:
        features = ObservationFeatures(spaces.Dict(observation=space))
        row = features({"observation": torch.as_tensor(np.array([value], space.dtype))})
        with subtests.test(str(space)):
            assert row.tolist() == [pytest.approx(expected)]


def test_convolutions_are_equivariant_to_translation() -> None:
    """A pattern moved by one column moves the outputs of each filter by one column."""
    features = ObservationFeatures(spaces.Dict(observation=PLANES, die=spaces.Discrete(3)), convolutions=[(5, 4, 1)])
    assert features.width == 5 * 3 * 4 + 3
    planes = torch.zeros((2, 6, 7, 2), dtype=torch.int8)
    planes[0, 2:5, 0:3, 0] = 1
    planes[1, 2:5, 1:4, 0] = 1
    rows = features({"observation": planes, "die": torch.tensor([0, 2])})
    assert rows[:, :3].tolist() == [[1, 0, 0], [0, 0, 1]]
    left, right = rows[:, 3:].reshape(2, 5, 3, 4)
    assert torch.allclose(left[:, :, :2], right[:, :, 1:3])
    assert not torch.allclose(left, right)


@pytest.mark.parametrize("shape", [(6, 7, 2), (2, 6, 7)], ids=["last", "first"])
@pytest.mark.parametrize("layers", [[(5, 4, 1), (3, 1, 1)], [(4, 3, 2)]], ids=["two layers", "stride"])
def test_small_images_have_equal_features_and_gradients_as_products(shape: tuple[int, ...], layers: list) -> None:
    torch.manual_seed(0)
    features = ObservationFeatures(spaces.Dict(observation=spaces.Box(0, 1, shape, np.float32)), layers)
    image = torch.rand(9, *shape)
    weights = torch.randn(9, features.width)
    with torch.no_grad():
        convolved = features({"observation": image})
    products = features({"observation": image})
    torch.testing.assert_close(products, convolved)
    (products * weights).sum().backward()
    gradients = [parameter.grad for parameter in features.parameters()]
    features.zero_grad()
    encoder = features.parts[0]
    encoder._is_small = False
    (features({"observation": image}) * weights).sum().backward()
    torch.testing.assert_close(gradients, [parameter.grad for parameter in features.parameters()])


@pytest.mark.parametrize("channels", [None, "first"])
def test_channels_first_and_last_give_the_same_features(channels: Channels | None) -> None:
    layers = [(16, 8, 4), (32, 4, 2)]
    last = ObservationFeatures(spaces.Dict(observation=spaces.Box(0, 255, (84, 60, 4), np.uint8)), layers)
    space = spaces.Dict(observation=spaces.Box(0, 255, (4, 84, 60), np.uint8))
    first = ObservationFeatures(space, layers, channels=channels)
    assert first.width == 32 * 9 * 6
    first.load_state_dict(last.state_dict())
    image = torch.randint(0, 256, (2, 84, 60, 4), dtype=torch.uint8)
    features = first({"observation": image.permute(0, 3, 1, 2)})
    assert torch.allclose(features, last({"observation": image}), atol=1e-5)


def test_the_setting_decides_where_the_shape_misleads() -> None:
    space = spaces.Dict(observation=spaces.Box(0, 1, (2, 6, 7), np.float32))
    assert ObservationFeatures(space, [(5, 2, 1)]).width == 5 * 5 * 6
    assert ObservationFeatures(space, [(5, 2, 1)], channels="last").width == 5 * 1 * 5


def test_the_axis_of_channels_is_seen_in_the_shape() -> None:
    for shape in ((3, 84, 84), (1, 28, 28), (2, 6, 7), (17, 40, 40)):
        assert channels_of(shape) == "first"
    for shape in ((84, 84, 3), (6, 7, 2), (8, 8, 111), (3, 3, 2), (6, 7, 20)):
        assert channels_of(shape) == "last"


def test_unsupported_convolutions_are_rejected(subtests: pytest.Subtests) -> None:
    rows: list[tuple[spaces.Space, list[tuple[int, int, int]], str]] = [
        (spaces.Box(0, 1, (9,)), [(8, 3, 1)], "no part"),
        (spaces.Box(0, 1, (3, 4, 1)), [(8, 4, 1)], "kernel 4 is larger than images of 3×4"),
        (spaces.Box(0, 1, (9, 9, 1)), [(8, 3, 3), (8, 4, 1)], "kernel 4 is larger than images of 3×3"),
        (spaces.Text(3), [], "unsupported observation space"),
    ]
    for space, convolutions, message in rows:
        with subtests.test(message), pytest.raises(ConfigError, match=message):
            ObservationFeatures(spaces.Dict(observation=space), convolutions)


def test_only_floats_are_normalized() -> None:
    space = spaces.Dict(
        die=spaces.Discrete(2), integers=spaces.Box(0, 9, (1,), np.int8), numbers=spaces.Box(0, 255, (1,), np.float64)
    )
    features = ObservationFeatures(space, normalize=True)
    numbers = torch.tensor([[10.0], [30.0]], dtype=torch.float64)
    batch = {"die": torch.tensor([0, 1]), "integers": torch.tensor([[3], [4]]), "numbers": numbers}
    features.update_statistics(batch)
    np.testing.assert_allclose(features(batch), [[1, 0, 3, -1], [0, 1, 4, 1]], rtol=1e-6)


def test_normalized_planes_are_convolved() -> None:
    features = ObservationFeatures(
        spaces.Dict(observation=spaces.Box(0, 9, (4, 4, 1))), convolutions=[(1, 4, 1)], normalize=True
    )
    planes = torch.rand(50, 4, 4, 1) * 9
    features.update_statistics({"observation": planes})
    standard = (planes - planes.mean(0)) / planes.std(0, correction=0)
    convolution = features.parts[0].convolutions
    assert torch.allclose(features({"observation": planes}), convolution(standard.permute(0, 3, 1, 2)), atol=1e-5)


@pytest.mark.parametrize("normalize", [False, True])
def test_a_box_of_shape_empty_is_one_number(normalize: bool) -> None:
    parts = {"observation.speed": spaces.Box(-1, 1, (), np.float32), "observation.position": spaces.Box(-1, 1, (2,))}
    features = ObservationFeatures(spaces.Dict(parts), normalize=normalize)
    observations = {"observation.speed": torch.tensor([0.5, -0.5]), "observation.position": torch.zeros(2, 2)}
    assert features(observations).tolist() == [[0, 0, 0.5], [0, 0, -0.5]]
    features.update_statistics(observations)
    assert features(observations).shape == (2, 3)


@given(
    st.lists(st.integers(1, 40), min_size=1, max_size=5), st.floats(-1e4, 1e4), st.floats(1e-2, 1e3), st.integers(0, 9)
)
@settings(max_examples=50)
def test_statistics_of_batches_equal_those_of_all_values(
    sizes: list[int], mean: float, deviation: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    batches = [rng.normal(mean, deviation, (size, 3)) for size in sizes]
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
    assert torch.allclose(scaled, torch.tensor([[1.0, 0.0], [-0.5, MAX_DEVIATIONS]]), atol=1e-5)


def test_statistics_are_part_of_the_weights() -> None:
    first, second = RunningNormalization((2,)), RunningNormalization((2,))
    first.update(torch.randn(9, 2))
    second.load_state_dict(first.state_dict())
    for normalization in (first, second):
        normalization.update(torch.ones(4, 2))
    assert torch.equal(first.mean, second.mean)
    assert torch.equal(first.variance, second.variance)
