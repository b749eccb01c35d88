import numpy as np
import pytest
import torch
from gymnasium import spaces

from training.modules.critic import Critic

SMALL = spaces.Dict({"observation": spaces.Box(-1, 1, (2,), np.float32)})
LARGE = spaces.Dict({"observation": spaces.Discrete(4), "action_mask": spaces.MultiBinary(3)})
BOX, CHOICE = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)
ROWS = 7


@pytest.mark.parametrize("normalize", [False, True])
def test_a_value_depends_on_all_observations_and_all_actions(normalize: bool) -> None:
    torch.manual_seed(0)
    critic = Critic([SMALL, LARGE], [BOX, CHOICE], [16], normalize=normalize)
    seen = [
        {"observation": torch.randn(ROWS, 2, requires_grad=True)},
        {"observation": torch.randint(4, (ROWS,)), "action_mask": torch.ones(ROWS, 3)},
    ]
    critic.update_statistics([{name: column.detach() for name, column in each.items()} for each in seen])
    done = [torch.randn(ROWS, 2, requires_grad=True), torch.randn(ROWS, 3, requires_grad=True)]
    values = critic(seen, done)
    assert values.shape == (ROWS,)
    values.sum().backward()
    for tensor in (seen[0]["observation"], *done):
        assert tensor.grad is not None
        assert (tensor.grad != 0).any(dim=1).all()
    other = critic([seen[0], {"observation": (seen[1]["observation"] + 1) % 4}], done)
    assert (other != values).all()


def test_keeps_statistics_only_where_asked() -> None:
    seen = [{"observation": 5 + torch.randn(ROWS, 2)}]
    plain, normalized = (Critic([SMALL], [BOX], [4], normalize=normalize) for normalize in (False, True))
    for critic in (plain, normalized):
        critic.update_statistics(seen)
    assert not list(plain.buffers())
    mean = seen[0]["observation"].mean(0).tolist()
    assert any(buffer.flatten().tolist() == pytest.approx(mean, abs=1e-5) for buffer in normalized.buffers())
