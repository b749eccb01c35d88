import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns

from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError
from tests.training.leagues import solvable
from training.algorithms.ppo import module_spec
from training.modules.shared_encoder import SharedEncoder

TWO = {"kwargs": {"agents": 2}, "policies": {"a": ["player_0"], "b": ["player_1"]}}


def built(league: LeagueConfig) -> SharedEncoder:
    torch.manual_seed(0)
    module = module_spec(league.training, interface(league)).build()
    assert isinstance(module, SharedEncoder)
    return module


@pytest.fixture
def module() -> SharedEncoder:
    return built(solvable("discrete", **TWO, shared_encoder=True))


def batch(**rows: list[int]) -> dict[str, dict[str, dict[str, torch.Tensor]]]:
    return {policy: {Columns.OBS: {"observation": torch.tensor(values)}} for policy, values in rows.items()}


def test_the_encoder_runs_once_for_all_rows(module: SharedEncoder) -> None:
    rows: list[int] = []
    module.encoder.register_forward_hook(lambda _, inputs, __: rows.append(len(inputs[0]["observation"])))
    for forward in (module.forward_exploration, module.forward_inference, module.forward_train):
        forward(batch(b=[0, 1, 2], a=[2]))
    assert rows == [4, 4, 4]


def test_policies_answer_together_what_each_answers_alone(module: SharedEncoder) -> None:
    asked = batch(b=[0, 1, 2], a=[2])
    learned = module.forward_train(asked)
    for forward in ("forward_exploration", "forward_inference"):
        together = getattr(module, forward)(asked)
        assert set(together) == {"a", "b"}
        for policy, columns in asked.items():
            alone = getattr(module[policy], forward)(columns)[Columns.ACTION_DIST_INPUTS]
            assert not together[policy][Columns.ACTION_DIST_INPUTS].requires_grad
            assert torch.allclose(together[policy][Columns.ACTION_DIST_INPUTS], alone, atol=1e-7)
            assert torch.allclose(learned[policy][Columns.ACTION_DIST_INPUTS], alone, atol=1e-7)
            values = module[policy].compute_values(columns)
            assert torch.allclose(learned[policy][Columns.VF_PREDS], values, atol=1e-7)
    heads = [module[policy].policy_head.weight for policy in ("a", "b")]
    assert not torch.equal(*heads)
    assert module.forward_inference({}) == {}


def test_one_encoder_has_fewer_parameters_and_stays_one_after_restoring(module: SharedEncoder) -> None:
    shared = {id(parameter) for part in module.values() for parameter in part.parameters()}
    own = {id(parameter) for parameter in module.encoder.parameters()}
    apart = sum(len(list(part.parameters())) for part in module.values())
    assert apart - len(shared) == len(own) > 0
    other = built(solvable("discrete", **TWO, shared_encoder=True, seed=6))
    with torch.no_grad():
        other.encoder.hidden[0].weight.zero_()
    other.set_state(module.get_state())
    assert other["a"].encoder is other["b"].encoder
    assert torch.equal(other.encoder.hidden[0].weight, module.encoder.hidden[0].weight)


def test_action_masks_may_differ_and_are_heeded() -> None:
    league = LeagueConfig.from_mapping(
        {
            "league": "tictactoe",
            "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
            "policies": {"a": ["player_1"], "b": ["player_2"]},
            "training": {"shared_encoder": True},
        }
    )
    net = built(league)
    mask = torch.tensor([[0] * 8 + [1], [1] + [0] * 8], dtype=torch.int8)
    observed = {"observation": torch.zeros((2, 3, 3, 2), dtype=torch.int8), "action_mask": mask}
    answer = net.forward_exploration({"a": {Columns.OBS: observed}, "b": {Columns.OBS: observed}})
    for policy in ("a", "b"):
        assert answer[policy][Columns.ACTION_DIST_INPUTS].argmax(-1).tolist() == [8, 0]


def test_policies_that_observe_different_spaces_are_refused() -> None:
    league = LeagueConfig.from_mapping(
        {
            "league": "adversary",
            "environment": {"entry_point": "mpe2.simple_adversary_v3"},
            "policies": {"adversary": ["adversary_*"], "good": ["agent_*"]},
            "training": {"shared_encoder": True},
        }
    )
    with pytest.raises(ConfigError, match="policies adversary and good observe different spaces"):
        module_spec(league.training, interface(league))


def test_statistics_are_those_of_all_policies() -> None:
    net = built(solvable("far_numbers", normalize_observations=True, shared_encoder=True))
    net["shared"].encoder.update_statistics({"observation": torch.from_numpy(np.array([[1.0], [3.0]]))})
    assert net.encoder.features.parts[0][0].mean.tolist() == [2.0]
