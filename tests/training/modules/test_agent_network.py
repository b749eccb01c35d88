from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns

from league.interface import AgentInterface
from league.policies.onnx import OnnxPolicy
from league.spaces import from_gymnasium
from training.export import export_policy
from training.modules.acting import ACTED, MASKED
from training.modules.agent_network import AgentNetwork
from training.modules.memory import HIDDEN

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


def seen(*shape: int) -> dict[str, torch.Tensor]:
    return {
        "observation": torch.randn(*shape, 2),
        "action_mask": torch.tensor([1, 0, 1], dtype=torch.int8).expand(*shape, 3),
    }


def first(agents: int) -> dict[str, torch.Tensor]:
    return {
        key: torch.as_tensor(value).expand(agents, -1).clone() for key, value in network().get_initial_state().items()
    }


@pytest.mark.parametrize("recurrence", [None, WIDTH])
def test_illegal_actions_are_neither_best_nor_explored(recurrence: int | None) -> None:
    module = network(recurrence)
    batch: dict[str, Any] = {Columns.OBS: seen(50), Columns.STATE_IN: first(50)}
    values = module.forward_inference(batch)[Columns.ACTION_DIST_INPUTS]
    assert (values[:, 1] == MASKED).all()
    module.exploration = 0.5
    explored = module.forward_exploration(batch)[Columns.ACTION_DIST_INPUTS].softmax(-1)
    assert (explored[:, 1] == 0).all()
    torch.testing.assert_close(explored[torch.arange(50), values.argmax(-1)], torch.full((50,), 0.75))


def test_learning_sees_the_values_that_were_acted_by() -> None:
    """Step by step as it is played, with actions that were drawn, and at once as it is learned from. Agent 1 is not
    there in step 2, and remembers on."""
    torch.manual_seed(3)
    module, steps, agents = network(), 5, 2
    observed, after = seen(steps, agents), seen(steps, agents)
    actions = torch.randint(0, ACTIONS, (steps, agents))
    present = torch.ones(steps, agents, dtype=torch.bool)
    present[2, 1] = False
    values, behind = module.unroll(observed, first(agents), actions, present)
    following = module.values_after(
        {name: rows.flatten(0, 1) for name, rows in after.items()}, actions.flatten(), behind.flatten(0, 1)
    ).unflatten(0, (steps, agents))
    state = first(agents)

    def act(rows: dict[str, torch.Tensor], before: dict[str, torch.Tensor]) -> dict[str, Any]:
        return module.forward_inference({Columns.OBS: rows, Columns.STATE_IN: before})

    for step in range(steps):
        there = present[step]
        answer = act({name: rows[step] for name, rows in observed.items()}, state)
        played = answer[Columns.ACTION_DIST_INPUTS][there]
        torch.testing.assert_close(values[step][there][:, [0, 2]], played[:, [0, 2]])
        new = {HIDDEN: answer[Columns.STATE_OUT][HIDDEN], ACTED: actions[step].unsqueeze(-1).float() + 1}
        state = {key: torch.where(there.unsqueeze(-1), new[key], state[key]) for key in state}
        later = act({name: rows[step] for name, rows in after.items()}, state)[Columns.ACTION_DIST_INPUTS]
        torch.testing.assert_close(following[step][there][:, [0, 2]], later[there][:, [0, 2]])


def test_what_was_done_last_is_remembered_as_if_it_were_the_best() -> None:
    module = network()
    assert module.get_initial_state()[ACTED].tolist() == [0]  # as all state that a graph begins with
    answer = module.forward_inference({Columns.OBS: seen(20), Columns.STATE_IN: first(20)})
    best = answer[Columns.ACTION_DIST_INPUTS].argmax(-1)
    assert answer[Columns.STATE_OUT][ACTED].squeeze(-1).tolist() == (best + 1).tolist()


def test_the_last_action_is_an_input() -> None:
    module, rows = network(), seen(1)
    answers = [
        module.forward_inference(
            {Columns.OBS: rows, Columns.STATE_IN: first(1) | {ACTED: torch.tensor([[float(action)]])}}
        )[Columns.ACTION_DIST_INPUTS]
        for action in range(4)  # none, or one of three
    ]
    assert len({tuple(answer[0].tolist()) for answer in answers}) == 4


def test_a_graph_begins_as_its_module_and_remembers_what_was_drawn(tmp_path: Path) -> None:
    module, agents = network(), 20
    spaces = AgentInterface(
        observation=from_gymnasium(SPACE), action=from_gymnasium(gymnasium.spaces.Discrete(ACTIONS))
    )
    export_policy(module, spaces, tmp_path / "own.onnx")
    policy = OnnxPolicy(tmp_path / "own.onnx")
    draws = [np.random.default_rng(agent) for agent in range(agents)]
    state, own, others = None, first(agents), 0
    for _ in range(4):
        rows = seen(agents)
        expected = module.forward_inference({Columns.OBS: rows, Columns.STATE_IN: own})
        answer = policy.act({name: row.numpy() for name, row in rows.items()}, state=state, explore=True, rng=draws)
        assert answer.dist_inputs is not None
        torch.testing.assert_close(torch.as_tensor(answer.dist_inputs), expected[Columns.ACTION_DIST_INPUTS])
        others += int((answer.actions != answer.dist_inputs.argmax(-1)).sum())
        taken = torch.as_tensor(answer.actions).float().unsqueeze(-1) + 1
        state, own = answer.state, {HIDDEN: expected[Columns.STATE_OUT][HIDDEN], ACTED: taken}
    assert others > 0
