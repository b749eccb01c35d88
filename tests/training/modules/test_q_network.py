import gymnasium
import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns

from training.modules.policy_module import MASKED_LOGIT, PREVIOUS_ACTION
from training.modules.q_network import NoisyLinear, QNetwork, epsilon_greedy
from training.modules.recurrent import HIDDEN

SPACE = gymnasium.spaces.Dict(
    {
        "observation": gymnasium.spaces.Box(-1, 1, (4,), np.float32),
        "action_mask": gymnasium.spaces.Box(0, 1, (3,), np.int8),
    }
)


def network(**config: object) -> QNetwork:
    torch.manual_seed(1)
    module = QNetwork(
        observation_space=SPACE,
        action_space=gymnasium.spaces.Discrete(3),
        model_config={"hidden": [8]} | config,
        inference_only=False,
    )
    with torch.no_grad():
        for parameter in module.advantages.parameters():
            parameter.normal_()
    return module


def batch(mask: list[list[int]]) -> dict[str, dict[str, torch.Tensor]]:
    torch.manual_seed(2)
    rows = torch.tensor(mask, dtype=torch.int8)
    return {Columns.OBS: {"observation": torch.randn(len(rows), 4), "action_mask": rows}}


KINDS = [
    {},
    {"dueling": True},
    {"noisy": True},
    {"atoms": (5, -2.0, 2.0)},
    {"dueling": True, "noisy": True, "atoms": (5, -2.0, 2.0)},
]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_illegal_actions_are_neither_best_nor_explored(kind: dict[str, object]) -> None:
    module, inputs = network(**kind), batch([[1, 0, 1], [0, 1, 0], [1, 1, 1]] * 30)
    allowed = inputs[Columns.OBS]["action_mask"].bool()
    values = module.forward_inference(inputs)[Columns.ACTION_DIST_INPUTS]
    assert allowed[torch.arange(len(values)), values.argmax(-1)].all()
    assert ((values == MASKED_LOGIT) == ~allowed).all()
    module.exploration = 0.5
    explored = module.forward_exploration(inputs)[Columns.ACTION_DIST_INPUTS].softmax(-1)
    assert (explored[~allowed] == 0).all()
    torch.testing.assert_close(explored.sum(-1), torch.ones(len(values)))
    again = module.forward_inference(inputs)[Columns.ACTION_DIST_INPUTS]
    assert torch.equal(values, again), "greedy inference is deterministic"


def test_epsilon_greedy_supports_values_of_zero() -> None:
    """RLlib masks by `q != 0`: it never explores a legal action of value 0, and fails on a row of zeros."""
    values = torch.tensor([[0.0, 0.0, MASKED_LOGIT], [0.0, 3.0, MASKED_LOGIT], [MASKED_LOGIT, 0.0, MASKED_LOGIT]])
    explored = epsilon_greedy(values, 0.2).softmax(-1)
    torch.testing.assert_close(explored, torch.tensor([[0.9, 0.1, 0.0], [0.1, 0.9, 0.0], [0.0, 1.0, 0.0]]))
    random = epsilon_greedy(torch.zeros(1, 3), 1.0).softmax(-1)
    torch.testing.assert_close(random, torch.full((1, 3), 1 / 3))


def test_advantages_of_legal_actions_have_mean_zero() -> None:
    module, inputs = network(dueling=True), batch([[1, 0, 1]] * 4)
    outputs = module.head_outputs(inputs[Columns.OBS])
    assert module.value is not None
    value = module.value(module.encoder(inputs[Columns.OBS]))
    torch.testing.assert_close(outputs[:, [0, 2]].mean(-1, keepdim=True), value)


def test_noise_is_factorized_and_disabled_in_inference() -> None:
    """y − y₀ = σ_w f(ε_out) f(ε_in)ᵀ x + σ_b f(ε_out): for x = 0 only the noise of the bias remains."""
    torch.manual_seed(3)
    layer = NoisyLinear(4, 2)
    x = torch.randn(5, 4)
    assert torch.equal(layer(x), layer(x))
    torch.manual_seed(4)
    noisy = layer(x, noise=True)
    torch.manual_seed(4)
    incoming, outgoing = torch.randn(4), torch.randn(2)
    scaled = [e.sign() * e.abs().sqrt() for e in (outgoing, incoming)]
    expected = layer(x) + 0.25 * (x @ scaled[1]).unsqueeze(1) * scaled[0] + 0.25 * scaled[0]
    torch.testing.assert_close(noisy, expected)


@pytest.mark.parametrize("kind", [{}, {"dueling": True, "atoms": (5, -2.0, 2.0)}], ids=str)
def test_a_recurrent_network_learns_from_sequences_as_it_acts(kind: dict[str, object]) -> None:
    """Compares two concatenated sequences of four steps, from stored states, with acting step by step."""
    module, sequences, steps = network(recurrence=6, **kind), 2, 4
    shape = sequences, steps
    columns = {name: column.unflatten(0, shape) for name, column in batch([[1, 1, 1]] * 8)[Columns.OBS].items()}
    actions = torch.randint(0, 3, shape)
    stored = {HIDDEN: torch.randn(*shape, 6), PREVIOUS_ACTION: torch.randint(0, 4, (*shape, 1)).float()}
    flat = {name: column.flatten(0, 1) for name, column in (columns | stored).items()}
    observations = {name: flat[name] for name in columns}
    hidden = module.hidden_states(observations, {key: flat[key] for key in stored}, actions.flatten(), steps)
    learned = module.expected(module.head_outputs(observations, hidden=hidden)).unflatten(0, shape)
    following = module.hidden_after(observations, actions.flatten(), hidden)
    later = module.expected(module.head_outputs(observations, hidden=following)).unflatten(0, shape)

    state = {key: column[:, 0] for key, column in stored.items()}
    for step in range(steps):
        inputs = {Columns.OBS: {name: column[:, step] for name, column in columns.items()}}
        answer = module.forward_inference(inputs | {Columns.STATE_IN: state})
        torch.testing.assert_close(learned[:, step], answer[Columns.ACTION_DIST_INPUTS])
        assert (answer[Columns.STATE_OUT][PREVIOUS_ACTION][:, 0] == learned[:, step].argmax(-1) + 1).all()
        state = {HIDDEN: answer[Columns.STATE_OUT][HIDDEN], PREVIOUS_ACTION: actions[:, step, np.newaxis].float() + 1}
        again = module.forward_inference(inputs | {Columns.STATE_IN: state})
        torch.testing.assert_close(later[:, step], again[Columns.ACTION_DIST_INPUTS])
