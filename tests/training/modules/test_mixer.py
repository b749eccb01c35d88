import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from training.modules.mixer import MonotonicMixer, summed, unmixed


@given(
    agents=st.integers(1, 5),
    size=st.integers(1, 6),
    width=st.integers(1, 8),
    scale=st.sampled_from([0.1, 1.0, 30.0]),
    seed=st.integers(0, 2**31),
    data=st.data(),
)
@settings(max_examples=200, deadline=None)
def test_the_team_is_worth_no_less_where_an_agent_is_worth_more(
    agents: int, size: int, width: int, scale: float, seed: int, data: st.DataObject
) -> None:
    """For any weights and any state, so that each agent's best action is part of the team's best one."""
    torch.manual_seed(seed)
    mixer = MonotonicMixer(agents, size, width).double()
    with torch.no_grad():
        for parameter in mixer.parameters():
            parameter.normal_(0, scale)
    states = scale * torch.randn(16, size, dtype=torch.float64)
    values = scale * torch.randn(16, agents, dtype=torch.float64)
    agent = data.draw(st.integers(0, agents - 1))
    more = values.clone()
    more[:, agent] += data.draw(st.floats(0.001, 100))
    before, after = mixer(values, states), mixer(more, states)
    assert (after >= before - 1e-9 * (1 + before.abs())).all()


def test_it_falls_somewhere_if_the_weights_may_be_negative(monkeypatch: pytest.MonkeyPatch) -> None:
    """The property above is one of the absolute values alone."""
    torch.manual_seed(0)
    mixer, states, values = MonotonicMixer(2, 3, 4), torch.randn(64, 3), torch.randn(64, 2)
    monkeypatch.setattr(torch.Tensor, "abs", lambda tensor: tensor)
    assert (mixer(values + torch.tensor([1.0, 0.0]), states) < mixer(values, states)).any()


def test_a_small_mixer_by_hand() -> None:
    """Two agents, a state of one number, s = 2, and a hidden layer of two.

    |W₁| = |s · [[1, -0.5], [-1, 1]]| = [[2, 1], [2, 2]]; b₁ = s · [0.5, -2] = [1, -4]; |W₂| = |s · [-1.5, 1]| = [3, 2];
    b₂ = -2 · relu(s · 0.5 - 0.25) + … by one hidden unit that is on (0.75) and one that is off.
    Q = (1, -1): hidden = (2 - 2 + 1, 1 - 2 - 4) = (1, -5); elu = (1, e⁻⁵ - 1).
    """
    mixer = MonotonicMixer(2, 1, 2).double()
    weights = {
        "first_weights.weight": [[1.0], [-0.5], [-1.0], [1.0]],
        "first_bias.weight": [[0.5], [-2.0]],
        "second_weights.weight": [[-1.5], [1.0]],
        "second_bias.0.weight": [[0.5], [-1.0]],
        "second_bias.0.bias": [-0.25, 0.0],
        "second_bias.2.weight": [[-2.0, 5.0]],
        "second_bias.2.bias": [0.125],
    }
    state = {name: torch.zeros_like(tensor) for name, tensor in mixer.state_dict().items()}
    mixer.load_state_dict(state | {name: torch.tensor(rows, dtype=torch.float64) for name, rows in weights.items()})
    found = mixer(torch.tensor([[1.0, -1.0]], dtype=torch.float64), torch.tensor([[2.0]], dtype=torch.float64))
    expected = 3 * 1 + 2 * (np.exp(-5) - 1) - 2 * 0.75 + 0.125
    np.testing.assert_allclose(found.detach().numpy(), [[expected]], rtol=1e-12)


def test_states_on_any_scale_are_normalised_where_asked_for() -> None:
    mixer = MonotonicMixer(2, 3, 4, normalize=True)
    states = 1e6 + 1e3 * torch.randn(512, 3)
    mixer.update_statistics(states)
    assert mixer(torch.zeros(512, 2), states).abs().max() < 10
    plain = MonotonicMixer(2, 3, 4)
    plain.update_statistics(states)
    assert plain(torch.zeros(512, 2), states).abs().max() > 1e4


def test_vdn_is_the_sum_and_alone_is_what_it_was() -> None:
    values, states = torch.tensor([[1.0, 2.5], [-1.0, 0.0]]), torch.zeros(2, 3)
    assert summed(values, states).tolist() == [[3.5], [-1.0]]
    assert unmixed(values, states).tolist() == values.tolist()
