import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from ray.rllib.core.columns import Columns

from league.errors import ConfigError
from training.modules.actor_critic import MASKED, ActorCritic

PLANES = spaces.Box(0, 1, (6, 7, 2), np.int8)
MASK = spaces.Box(0, 1, (7,), np.int8)


def module(action: spaces.Space | None = None, recurrence: int | None = None, **parts: spaces.Space) -> ActorCritic:
    torch.manual_seed(0)
    return ActorCritic(
        observation_space=spaces.Dict(parts),
        action_space=action or spaces.Discrete(7),
        model_config={"hidden": [16, 8], "recurrence": recurrence},
    )


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


@pytest.mark.parametrize("action", [spaces.Discrete(7), spaces.MultiDiscrete([3, 4])])
def test_entropy_and_gradient_are_finite_where_one_action_is_legal(action: spaces.Space) -> None:
    net = module(action, observation=PLANES, action_mask=MASK)
    mask = torch.zeros((4, 7), dtype=torch.bool)
    mask[:, 2] = True
    raw = torch.full((4,), 2)
    if isinstance(action, spaces.MultiDiscrete):
        mask[:, 3] = True
        raw = torch.tensor([[2, 0]] * 4)
    batch = {Columns.OBS: {"observation": torch.ones((4, 6, 7, 2), dtype=torch.int8), "action_mask": mask}}
    out = net.forward_train(batch)
    log_p, entropy = net.distribution.evaluate(out[Columns.ACTION_DIST_INPUTS], raw)
    (log_p.sum() + entropy.sum() + out[Columns.VF_PREDS].sum()).backward()
    assert torch.equal(entropy, torch.zeros(4))
    assert torch.equal(log_p, torch.zeros(4))
    assert all(torch.isfinite(param.grad).all() for param in net.parameters())


def test_values_are_the_same_in_each_pass() -> None:
    net = module(observation=PLANES)
    batch = {Columns.OBS: {"observation": torch.randint(0, 2, (5, 6, 7, 2), dtype=torch.int8)}}
    values = net.compute_values(batch)
    assert values.shape == (5,)
    assert torch.equal(values, net.forward_train(batch)[Columns.VF_PREDS])
    assert torch.equal(values, net.value_step(batch)[0])
    assert torch.equal(values, net.compute_values(batch, net.encoder(batch[Columns.OBS])))
    assert net.get_initial_state() == {}
    assert not net.is_stateful()


def test_a_memory_learns_from_sequences_what_it_does_step_by_step() -> None:
    """Three sequences of 4, 1 and 3 steps, each from a state of its own, give the same as acting through them."""
    net = module(recurrence=5, die=spaces.Discrete(6))
    lengths, rolls = [4, 1, 3], torch.randint(0, 6, (8,))
    first = {key: torch.randn(3, 5) for key in net.get_initial_state()}
    learned = net.forward_train(
        {Columns.OBS: {"die": rolls}, Columns.STATE_IN: first, Columns.SEQ_LENS: torch.tensor(lengths)}
    )
    inputs, values, row = [], [], 0
    for i, length in enumerate(lengths):
        state = {key: value[i : i + 1] for key, value in first.items()}
        for _ in range(length):
            batch = {Columns.OBS: {"die": rolls[row : row + 1]}, Columns.STATE_IN: state}
            acted = net.forward_inference(batch)
            values.append(net.value_step(batch)[0])
            inputs.append(acted[Columns.ACTION_DIST_INPUTS])
            state, row = acted[Columns.STATE_OUT], row + 1
    assert torch.allclose(learned[Columns.ACTION_DIST_INPUTS], torch.cat(inputs), atol=1e-6)
    assert torch.allclose(learned[Columns.VF_PREDS], torch.cat(values), atol=1e-6)
    assert net.is_stateful()
    assert {key: value.tolist() for key, value in net.get_initial_state().items()} == {"h": [0] * 5, "c": [0] * 5}


def test_a_memory_tells_histories_apart_and_sequences_do_not_leak() -> None:
    net = module(recurrence=5, die=spaces.Discrete(6))
    state = {key: torch.zeros(2, 5) for key in net.get_initial_state()}

    def last_of_both(rolls: list[int]) -> list[float]:
        batch = {Columns.OBS: {"die": torch.tensor(rolls)}, Columns.STATE_IN: state}
        values = net.forward_train(batch | {Columns.SEQ_LENS: torch.tensor([2, 2])})[Columns.VF_PREDS]
        return values[[1, 3]].tolist()

    before, changed = last_of_both([1, 4, 2, 4]), last_of_both([3, 4, 2, 4])
    assert before[0] != changed[0]
    assert before[1] == changed[1]


def test_the_deviation_of_numbers_does_not_depend_on_the_observation() -> None:
    net = module(spaces.Box(-1, 1, (2, 2)), observation=PLANES)
    batch = {Columns.OBS: {"observation": torch.randint(0, 2, (5, 6, 7, 2), dtype=torch.int8)}}
    inputs = net.forward_train(batch)[Columns.ACTION_DIST_INPUTS]
    assert inputs.shape == (5, 8)
    assert (inputs[:, 4:] == -0.5).all()
    assert len(inputs[:, :4].unique(dim=0)) == 5
    with torch.no_grad():
        net.log_deviations.fill_(9)
    assert (net.forward_train(batch)[Columns.ACTION_DIST_INPUTS][:, 4:] == 2).all()


@pytest.mark.parametrize("action", [spaces.Box(0, 3, (2,), np.int8), spaces.MultiBinary(3), spaces.Text(3)])
def test_other_actions_are_refused(action: spaces.Space) -> None:
    with pytest.raises(ConfigError, match="no policy has actions of"):
        module(action, observation=PLANES)
