import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from ray.rllib.core.columns import Columns

from league.errors import ConfigError
from training.modules.actor_critic import MASKED, ActorCritic
from training.modules.features import Features


def module(**parts: spaces.Space) -> ActorCritic:
    torch.manual_seed(0)
    return ActorCritic(
        observation_space=spaces.Dict(parts), action_space=spaces.Discrete(7), model_config={"hidden": [16, 8]}
    )


PLANES = spaces.Box(0, 1, (6, 7, 2), np.int8)
MASK = spaces.Box(0, 1, (7,), np.int8)


@given(st.lists(st.lists(st.booleans(), min_size=7, max_size=7).filter(any), min_size=1, max_size=5))
@settings(max_examples=30, deadline=None)
def test_illegal_actions_have_probability_zero_and_legal_ones_their_logits(rows: list[list[bool]]) -> None:
    net = module(observation=PLANES, action_mask=MASK)
    planes = torch.randint(0, 2, (len(rows), 6, 7, 2), dtype=torch.int8)
    mask = torch.tensor(rows, dtype=torch.int8)
    masked = net.forward_inference({Columns.OBS: {"observation": planes, "action_mask": mask}})
    plain = net.forward_inference({Columns.OBS: {"observation": planes}})
    logits, legal = masked[Columns.ACTION_DIST_INPUTS], mask.bool()
    assert (logits[~legal] == MASKED).all()
    assert torch.equal(logits[legal], plain[Columns.ACTION_DIST_INPUTS][legal])
    assert (torch.softmax(logits, -1)[~legal] == 0).all()


def test_entropy_and_gradient_are_finite_where_one_action_is_legal() -> None:
    net = module(observation=PLANES, action_mask=MASK)
    mask = torch.zeros((4, 7), dtype=torch.int8)
    mask[:, 3] = 1
    batch = {Columns.OBS: {"observation": torch.ones((4, 6, 7, 2), dtype=torch.int8), "action_mask": mask}}
    out = net.forward_train(batch)
    distribution = net.get_train_action_dist_cls().from_logits(out[Columns.ACTION_DIST_INPUTS])
    (distribution.entropy().sum() + net.compute_values(batch, out[Columns.EMBEDDINGS]).sum()).backward()
    assert torch.equal(distribution.entropy(), torch.zeros(4))
    assert all(torch.isfinite(param.grad).all() for param in net.parameters())


def test_values_are_the_same_with_and_without_embeddings() -> None:
    net = module(observation=PLANES)
    batch = {Columns.OBS: {"observation": torch.randint(0, 2, (5, 6, 7, 2), dtype=torch.int8)}}
    embeddings = net.forward_train(batch)[Columns.EMBEDDINGS]
    values = net.compute_values(batch)
    assert values.shape == (5,)
    assert torch.equal(values, net.compute_values(batch, embeddings))


def test_features_of_all_leaves() -> None:
    """Parts stand in the order of their names; integers are one-hot from their start on."""
    net = module(
        **{
            "observation.box": spaces.Box(-1, 1, (2,), np.float32),
            "observation.die": spaces.Discrete(3, start=1),
            "observation.pair": spaces.MultiDiscrete([2, 3]),
            "observation.switches": spaces.MultiBinary(2),
        }
    )
    row = net.features(
        {
            "observation.box": torch.tensor([[0.5, -0.5]]),
            "observation.die": torch.tensor([3]),
            "observation.pair": torch.tensor([[1, 2]]),
            "observation.switches": torch.tensor([[1, 0]], dtype=torch.int8),
        }
    )
    assert net.features.width == 12
    assert row.tolist() == [[0.5, -0.5, 0, 0, 1, 0, 1, 0, 0, 1, 1, 0]]


def test_other_actions_than_discrete_are_refused() -> None:
    with pytest.raises(ConfigError, match="Discrete"):
        ActorCritic(
            observation_space=spaces.Dict(observation=PLANES),
            action_space=spaces.Box(-1, 1, (2,)),
            model_config={"hidden": [8]},
        )


def test_convolutions_see_each_place_of_the_planes_alike() -> None:
    """A pattern moved by one column moves the answers of each filter by one column."""
    features = Features(spaces.Dict(observation=PLANES, die=spaces.Discrete(3)), convolutions=[(5, 4)])
    assert features.width == 5 * 3 * 4 + 3
    planes = torch.zeros((2, 6, 7, 2), dtype=torch.int8)
    planes[0, 2:5, 0:3, 0] = 1
    planes[1, 2:5, 1:4, 0] = 1
    rows = features({"observation": planes, "die": torch.tensor([0, 2])})
    assert rows[:, :3].tolist() == [[1, 0, 0], [0, 0, 1]]
    left, right = rows[:, 3:].reshape(2, 5, 3, 4)
    assert torch.allclose(left[:, :, :2], right[:, :, 1:3])
    assert not torch.allclose(left, right)


@pytest.mark.parametrize(
    ("space", "kernel", "words"),
    [(spaces.Box(0, 1, (9,)), 3, "no part"), (spaces.Box(0, 1, (3, 4, 1)), 4, "kernel of 4 is larger")],
)
def test_convolutions_that_do_not_fit_are_refused(space: spaces.Space, kernel: int, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Features(spaces.Dict(observation=space), convolutions=[(8, kernel)])
