"""Agent networks and mixers."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from ray.rllib.core.columns import Columns

from league.interface import AgentInterface
from league.policies.onnx import OnnxPolicy
from league.spaces.conversion import from_gymnasium
from tests.support.examples import examples
from training.export.onnx_export import export_policy
from training.modules.policy_module import MASKED_LOGIT, PREVIOUS_ACTION
from training.modules.qmix import AgentNetwork, MonotonicMixer, independent_mixer, vdn_mixer
from training.modules.recurrent import HIDDEN

ACTIONS, WIDTH = 3, 4
SPACE = gymnasium.spaces.Dict(
    {
        "observation": gymnasium.spaces.Box(-1, 1, (2,), np.float32),
        "action_mask": gymnasium.spaces.Box(0, 1, (ACTIONS,), np.int8),
    }
)


def network(recurrence: int | None = WIDTH) -> AgentNetwork:
    torch.manual_seed(1)
    module = AgentNetwork(
        observation_space=SPACE,
        action_space=gymnasium.spaces.Discrete(ACTIONS),
        model_config={"hidden": [8], "recurrence": recurrence},
        inference_only=False,
    )
    with torch.no_grad():
        module.head.weight.normal_()
    return module


def observation_batch(*shape: int) -> dict[str, torch.Tensor]:
    return {
        "observation": torch.randn(*shape, 2),
        "action_mask": torch.tensor([1, 0, 1], dtype=torch.int8).expand(*shape, 3),
    }


def initial_state(agents: int) -> dict[str, torch.Tensor]:
    return {
        key: torch.as_tensor(value).expand(agents, -1).clone() for key, value in network().get_initial_state().items()
    }


@pytest.mark.parametrize("recurrence", [None, WIDTH])
def test_illegal_actions_are_neither_best_nor_explored(recurrence: int | None) -> None:
    module = network(recurrence)
    batch: dict[str, Any] = {Columns.OBS: observation_batch(50), Columns.STATE_IN: initial_state(50)}
    values = module.forward_inference(batch)[Columns.ACTION_DIST_INPUTS]
    assert (values[:, 1] == MASKED_LOGIT).all()
    module.exploration = 0.5
    explored = module.forward_exploration(batch)[Columns.ACTION_DIST_INPUTS].softmax(-1)
    assert (explored[:, 1] == 0).all()
    torch.testing.assert_close(explored[torch.arange(50), values.argmax(-1)], torch.full((50,), 0.75))


def test_learning_computes_the_values_of_acting() -> None:
    """Compares acting step by step, with drawn actions, with one pass over the sequence. Agent 1 is absent in step 2,
    and keeps its state.
    """
    torch.manual_seed(3)
    module, steps, agents = network(), 5, 2
    observed, after = observation_batch(steps, agents), observation_batch(steps, agents)
    actions = torch.randint(0, ACTIONS, (steps, agents))
    present = torch.ones(steps, agents, dtype=torch.bool)
    present[2, 1] = False
    values, behind = module.unroll(observed, initial_state(agents), actions, present)
    following = module.values_after(
        {name: rows.flatten(0, 1) for name, rows in after.items()}, actions.flatten(), behind.flatten(0, 1)
    ).unflatten(0, (steps, agents))
    state = initial_state(agents)

    def act(rows: dict[str, torch.Tensor], before: dict[str, torch.Tensor]) -> dict[str, Any]:
        return module.forward_inference({Columns.OBS: rows, Columns.STATE_IN: before})

    for step in range(steps):
        there = present[step]
        answer = act({name: rows[step] for name, rows in observed.items()}, state)
        played = answer[Columns.ACTION_DIST_INPUTS][there]
        torch.testing.assert_close(values[step][there][:, [0, 2]], played[:, [0, 2]])
        new = {HIDDEN: answer[Columns.STATE_OUT][HIDDEN], PREVIOUS_ACTION: actions[step].unsqueeze(-1).float() + 1}
        state = {key: torch.where(there.unsqueeze(-1), new[key], state[key]) for key in state}
        later = act({name: rows[step] for name, rows in after.items()}, state)[Columns.ACTION_DIST_INPUTS]
        torch.testing.assert_close(following[step][there][:, [0, 2]], later[there][:, [0, 2]])


def test_the_previous_action_is_an_input() -> None:
    module, rows = network(), observation_batch(1)
    outputs = [
        module.forward_inference(
            {Columns.OBS: rows, Columns.STATE_IN: initial_state(1) | {PREVIOUS_ACTION: torch.tensor([[float(action)]])}}
        )[Columns.ACTION_DIST_INPUTS]
        for action in range(4)  # no action, or one of three
    ]
    assert len({tuple(answer[0].tolist()) for answer in outputs}) == 4


def test_a_graph_starts_like_its_module_and_remembers_drawn_actions(tmp_path: Path) -> None:
    module, agents = network(), 20
    spaces = AgentInterface(
        observation=from_gymnasium(SPACE), action=from_gymnasium(gymnasium.spaces.Discrete(ACTIONS))
    )
    export_policy(module, spaces, tmp_path / "own.onnx")
    policy = OnnxPolicy(tmp_path / "own.onnx")
    draws = [np.random.default_rng(agent) for agent in range(agents)]
    state, state_of_module, explored = None, initial_state(agents), 0
    for _ in range(4):
        rows = observation_batch(agents)
        expected = module.forward_inference({Columns.OBS: rows, Columns.STATE_IN: state_of_module})
        answer = policy.act({name: row.numpy() for name, row in rows.items()}, state=state, explore=True, rng=draws)
        assert answer.dist_inputs is not None
        torch.testing.assert_close(torch.as_tensor(answer.dist_inputs), expected[Columns.ACTION_DIST_INPUTS])
        explored += int((answer.actions != answer.dist_inputs.argmax(-1)).sum())
        drawn = torch.as_tensor(answer.actions).float().unsqueeze(-1) + 1
        state, state_of_module = answer.state, {HIDDEN: expected[Columns.STATE_OUT][HIDDEN], PREVIOUS_ACTION: drawn}
    assert explored > 0


@given(
    agents=st.integers(1, 5),
    size=st.integers(1, 6),
    width=st.integers(1, 8),
    scale=st.sampled_from([0.1, 1.0, 30.0]),
    seed=st.integers(0, 2**31),
    data=st.data(),
)
@examples(75)
def test_the_mixer_is_monotonic(
    agents: int, size: int, width: int, scale: float, seed: int, data: st.DataObject
) -> None:
    """For any weights and states, so that the best action of each agent is part of the best joint action."""
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
    joint = mixer(torch.tensor([[1.0, -1.0]], dtype=torch.float64), torch.tensor([[2.0]], dtype=torch.float64))
    expected = 3 * 1 + 2 * (np.exp(-5) - 1) - 2 * 0.75 + 0.125
    np.testing.assert_allclose(joint.detach().numpy(), [[expected]], rtol=1e-12)


def test_states_are_normalized_if_requested() -> None:
    mixer = MonotonicMixer(2, 3, 4, normalize=True)
    states = 1e6 + 1e3 * torch.randn(512, 3)
    mixer.update_statistics(states)
    assert mixer(torch.zeros(512, 2), states).abs().max() < 10
    plain = MonotonicMixer(2, 3, 4)
    plain.update_statistics(states)
    assert plain(torch.zeros(512, 2), states).abs().max() > 1e4


def test_vdn_is_the_sum_and_independent_values_are_unchanged() -> None:
    values, states = torch.tensor([[1.0, 2.5], [-1.0, 0.0]]), torch.zeros(2, 3)
    torch.testing.assert_close(vdn_mixer(values, states), torch.tensor([[3.5], [-1.0]]))
    assert independent_mixer(values, states).tolist() == values.tolist()
