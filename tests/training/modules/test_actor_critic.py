"""Actor-critic networks, and encoders shared by several policies."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from ray.rllib.core.columns import Columns
from torch import Tensor, distributions

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.actions import dist_inputs_size
from league.spaces.conversion import from_gymnasium
from tests.support.leagues.training_leagues import small, solvable
from training.algorithms.rllib_config import module_spec
from training.modules.actor_critic import ActorCritic, SharedEncoder
from training.modules.distributions import torch_distribution
from training.modules.policy_module import MASKED_LOGIT
from training.modules.recurrent import GRULayer
from training.modules.value_function import ReturnNormalization

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
@settings(max_examples=30)
def test_illegal_actions_have_probability_zero_and_legal_ones_keep_their_logits(rows: list[list[bool]]) -> None:
    net = module(observation=PLANES, action_mask=MASK)
    planes = torch.randint(0, 2, (len(rows), 6, 7, 2), dtype=torch.int8)
    mask = torch.tensor(rows, dtype=torch.int8)
    masked = net.forward_inference({Columns.OBS: {"observation": planes, "action_mask": mask}})
    plain = net.forward_inference({Columns.OBS: {"observation": planes}})
    logits, legal = masked[Columns.ACTION_DIST_INPUTS], mask.bool()
    assert (logits[~legal] == MASKED_LOGIT).all()
    torch.testing.assert_close(logits[legal], plain[Columns.ACTION_DIST_INPUTS][legal])
    assert (torch.softmax(logits, -1)[~legal] == 0).all()


@pytest.mark.parametrize("action", [spaces.Discrete(7), spaces.MultiDiscrete([3, 4])])
def test_entropy_and_gradient_are_finite_with_one_legal_action(action: spaces.Space) -> None:
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
    torch.testing.assert_close(entropy, torch.zeros(4))
    torch.testing.assert_close(log_p, torch.zeros(4))
    assert all(torch.isfinite(param.grad).all() for param in net.parameters())


def test_values_are_equal_in_each_pass() -> None:
    net = module(observation=PLANES)
    batch = {Columns.OBS: {"observation": torch.randint(0, 2, (5, 6, 7, 2), dtype=torch.int8)}}
    values = net.compute_values(batch)
    assert values.shape == (5,)
    torch.testing.assert_close(values, net.forward_train(batch)[Columns.VF_PREDS])
    torch.testing.assert_close(values, net.value_step(batch)[0])
    torch.testing.assert_close(values, net.compute_values(batch, net.encoder(batch[Columns.OBS])))
    assert net.get_initial_state() == {}
    assert not net.is_stateful()


def test_a_recurrent_network_learns_from_sequences_as_step_by_step() -> None:
    """Three sequences of 4, 1 and 3 steps, each with its own first state, equal the steps one by one."""
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


def test_a_recurrent_network_distinguishes_histories_and_separates_sequences() -> None:
    net = module(recurrence=5, die=spaces.Discrete(6))
    state = {key: torch.zeros(2, 5) for key in net.get_initial_state()}

    def last_values(rolls: list[int]) -> list[float]:
        batch = {Columns.OBS: {"die": torch.tensor(rolls)}, Columns.STATE_IN: state}
        values = net.forward_train(batch | {Columns.SEQ_LENS: torch.tensor([2, 2])})[Columns.VF_PREDS]
        return values[[1, 3]].tolist()

    before, changed = last_values([1, 4, 2, 4]), last_values([3, 4, 2, 4])
    assert before[0] != changed[0]
    assert before[1] == changed[1]


def test_the_deviation_of_box_actions_does_not_depend_on_the_observation() -> None:
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
def test_unsupported_action_spaces_are_rejected(action: spaces.Space) -> None:
    with pytest.raises(ConfigError, match="unsupported action space"):
        module(action, observation=PLANES)


TWO = {"kwargs": {"agents": 2}, "policies": {"a": ["player_0"], "b": ["player_1"]}}


def build(league: LeagueConfig) -> SharedEncoder:
    torch.manual_seed(0)
    module = module_spec(league.training, interface(league)).build()
    assert isinstance(module, SharedEncoder)
    return module


@pytest.fixture
def shared_module() -> SharedEncoder:
    return build(solvable("discrete", **TWO, shared_encoder=True))


def batch(**rows: list[int]) -> dict[str, dict[str, dict[str, torch.Tensor]]]:
    return {policy: {Columns.OBS: {"observation": torch.tensor(values)}} for policy, values in rows.items()}


def test_the_encoder_runs_once_for_all_rows(shared_module: SharedEncoder) -> None:
    rows: list[int] = []
    shared_module.encoder.register_forward_hook(lambda _, inputs, __: rows.append(len(inputs[0]["observation"])))
    for forward in (shared_module.forward_exploration, shared_module.forward_inference, shared_module.forward_train):
        forward(batch(b=[0, 1, 2], a=[2]))
    assert rows == [4, 4, 4]


def test_policies_give_the_same_result_together_and_alone(shared_module: SharedEncoder) -> None:
    inputs = batch(b=[0, 1, 2], a=[2])
    learned = shared_module.forward_train(inputs)
    for forward in ("forward_exploration", "forward_inference"):
        together = getattr(shared_module, forward)(inputs)
        assert set(together) == {"a", "b"}
        for policy, columns in inputs.items():
            alone = getattr(shared_module[policy], forward)(columns)[Columns.ACTION_DIST_INPUTS]
            assert not together[policy][Columns.ACTION_DIST_INPUTS].requires_grad
            assert torch.allclose(together[policy][Columns.ACTION_DIST_INPUTS], alone, atol=1e-7)
            assert torch.allclose(learned[policy][Columns.ACTION_DIST_INPUTS], alone, atol=1e-7)
            values = shared_module[policy].compute_values(columns)
            assert torch.allclose(learned[policy][Columns.VF_PREDS], values, atol=1e-7)
    heads = [shared_module[policy].policy_head.weight for policy in ("a", "b")]
    assert not torch.equal(*heads)
    assert shared_module.forward_inference({}) == {}


def test_a_shared_encoder_has_fewer_parameters_and_remains_shared_after_restoring(shared_module: SharedEncoder) -> None:
    shared = {id(parameter) for part in shared_module.values() for parameter in part.parameters()}
    apart = sum(len(list(part.parameters())) for part in shared_module.values())
    assert apart - len(shared) == len(list(shared_module.encoder.parameters())) > 0
    other = build(solvable("discrete", **TWO, shared_encoder=True, seed=6))
    with torch.no_grad():
        other.encoder.hidden[0].weight.zero_()
    other.set_state(shared_module.get_state())
    assert other["a"].encoder is other["b"].encoder
    assert torch.equal(other.encoder.hidden[0].weight, shared_module.encoder.hidden[0].weight)


def test_policies_can_have_different_action_masks() -> None:
    policies = {"a": ["player_1"], "b": ["player_2"]}
    net = build(small("pettingzoo.classic.tictactoe_v3", policies=policies, shared_encoder=True))
    mask = torch.tensor([[0] * 8 + [1], [1] + [0] * 8], dtype=torch.int8)
    observed = {"observation": torch.zeros((2, 3, 3, 2), dtype=torch.int8), "action_mask": mask}
    answer = net.forward_exploration({"a": {Columns.OBS: observed}, "b": {Columns.OBS: observed}})
    for policy in ("a", "b"):
        assert answer[policy][Columns.ACTION_DIST_INPUTS].argmax(-1).tolist() == [8, 0]


def test_policies_with_different_observation_spaces_are_rejected() -> None:
    policies = {"adversary": ["adversary_*"], "good": ["agent_*"]}
    league = small("mpe2.simple_adversary_v3", policies=policies, shared_encoder=True)
    with pytest.raises(ConfigError, match="policies adversary and good have different observation spaces"):
        module_spec(league.training, interface(league))


def test_statistics_cover_all_policies() -> None:
    net = build(solvable("far_numbers", normalize_observations=True, shared_encoder=True))
    net["shared"].encoder.update_statistics({"observation": torch.from_numpy(np.array([[1.0], [3.0]]))})
    assert net.encoder.features.parts[0][0].mean.tolist() == pytest.approx([2.0])


RETURNS = arrays(np.float64, st.integers(2, 20), elements=st.floats(-1e4, 1e4))


@given(st.lists(RETURNS, max_size=3))
def test_units_are_the_mean_and_deviation_of_all_returns(batches: list[np.ndarray]) -> None:
    scale = ReturnNormalization()
    for batch in batches:
        scale.update(torch.from_numpy(batch))
    together = np.concatenate(batches) if batches else np.array([-1.0, 1.0])
    np.testing.assert_allclose(scale.denormalized(np.zeros(1)), together.mean(), atol=1e-6)
    np.testing.assert_allclose(scale.deviation, np.sqrt(together.var() + 1e-8), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(scale.denormalized(scale.normalized(together)), together, atol=1e-6)


def test_rare_returns_are_not_clipped() -> None:
    scale = ReturnNormalization()
    scale.update(torch.tensor([0.0] * 999 + [1000.0]))
    assert scale.normalized(np.array([1000.0]))[0] == pytest.approx(31.6, abs=0.1)


def test_the_layer_equals_torchs_gru_cell() -> None:
    torch.manual_seed(0)
    layer, cell = GRULayer(5, 4), torch.nn.GRUCell(5, 4)
    with torch.no_grad():
        for part, name in ((layer.from_input, "ih"), (layer.from_hidden, "hh")):
            part.bias.normal_()
            getattr(cell, f"weight_{name}").copy_(part.weight)
            getattr(cell, f"bias_{name}").copy_(part.bias)
    inputs, hidden = torch.randn(7, 5), torch.randn(7, 4)
    torch.testing.assert_close(layer(inputs, hidden), cell(inputs, hidden))


DISCRETE, PAIR, BOX = spaces.Discrete(4, start=2), spaces.MultiDiscrete([[2], [3]]), spaces.Box(-1, 1, (2, 1))
SPACES = pytest.mark.parametrize("space", [DISCRETE, PAIR, BOX], ids=["discrete", "multi", "box"])
ROWS = 50


def reference(space: spaces.Space, inputs: Tensor) -> list[distributions.Distribution]:
    """torch's distributions, one for each element."""
    if space is BOX:
        return [distributions.Normal(inputs[:, i], inputs[:, 2 + i].exp()) for i in range(2)]
    parts = [inputs] if space is DISCRETE else [inputs[:, :2], inputs[:, 2:]]
    return [distributions.Categorical(logits=part) for part in parts]


def dist_inputs(space: spaces.Space, seed: int) -> Tensor:
    torch.manual_seed(seed)
    return torch.randn(ROWS, dist_inputs_size(from_gymnasium(space)))


@SPACES
def test_evaluation_equals_torch(space: spaces.Space) -> None:
    old, new = dist_inputs(space, 0), dist_inputs(space, 1)
    ours, elements = torch_distribution(space), reference(space, old)
    raw = torch.stack([element.sample() for element in elements], dim=-1)
    log_p, entropy = ours.evaluate(old, raw[:, 0] if space is DISCRETE else raw)
    expected = sum(element.log_prob(raw[:, i]) for i, element in enumerate(elements))
    assert torch.allclose(log_p, expected, atol=1e-5)
    assert torch.allclose(entropy, sum(element.entropy() for element in elements), atol=1e-5)
    pairs = zip(elements, reference(space, new), strict=True)
    assert torch.allclose(
        ours.divergence(old, new), sum(distributions.kl_divergence(a, b) for a, b in pairs), atol=1e-4
    )
    torch.testing.assert_close(ours.divergence(old, old), torch.zeros(ROWS))
    mode = torch.stack([element.mode for element in elements], dim=-1)
    assert torch.equal(ours.mode(old), mode[:, 0] if space is DISCRETE else mode)
