"""The learner alone, on joint transitions sampled by a runner in this process."""

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from ray.rllib.core.learner.learner import DEFAULT_OPTIMIZER

from league.config.league import LeagueConfig
from league.environments.building import interface
from tests.support.leagues.training_leagues import maddpg
from training.algorithms.rllib_config import algorithm_config
from training.learners.maddpg import AgentSlot, MADDPGLearner, critic_loss, critic_name
from training.replay_buffer import ReplayBuffer, Sample
from training.sampling.closed_transitions import JOINT
from training.sampling.replay_runner import ActorRunner

OWN = {"a": ["player_0"], "b": ["player_1"]}
GAMMA = 0.95


def learner_of(league: LeagueConfig) -> MADDPGLearner:
    torch.manual_seed(0)
    config = algorithm_config(league, interface(league))
    learner = MADDPGLearner(config=config, module_spec=config.rl_module_spec)
    learner.build()
    return learner


def sample_transitions(league: LeagueConfig, actions: int = 600) -> Sample:
    """All transitions, in order."""
    runner = ActorRunner(config=algorithm_config(league, interface(league)), worker_index=0)
    try:
        _, blocks = runner.transitions(actions, exploration=0.5)
    finally:
        runner.stop()
    replay = ReplayBuffer(10_000)
    replay.add(blocks[JOINT])
    indices = np.arange(len(replay))
    return Sample(replay.rows(indices, gamma=GAMMA), indices, np.ones(len(indices), np.float32))


def twice(sample: Sample) -> Sample:
    """The same rows for each of two policies."""
    rows = {name: np.concatenate([column, column]) for name, column in sample.rows.items()}
    return Sample(rows, np.tile(sample.indices, 2), np.tile(sample.weights, 2))


def weights(network: torch.nn.Module) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in network.parameters()]


def are_equal(first: list[torch.Tensor], second: list[torch.Tensor]) -> bool:
    return all(map(torch.equal, first, second))


def test_targets_follow_equation_6_and_bootstrap_truncated_agents() -> None:
    """In this environment player_1 terminates after two of four rounds, player_0 is truncated at the end."""
    league = maddpg("summing", {"ends": 2}, OWN)
    learner, sample = learner_of(league), sample_transitions(league)
    batch = learner.batch(sample)
    rows = batch.rows
    for head, flags in (("truncated/a", "terminated/a"), ("terminated/b", "truncated/b")):
        assert rows[head].any(), "both kinds of ending occur"
        assert not rows[flags].any()
    order = [learner._critic_agents(AgentSlot("a", 0))]
    targets = learner._targets("a", batch, order)
    stays = rows["present/b"] & ~rows["terminated/b"]
    observations = [{"observation": rows[f"next_observations/{agent}/observation"][:, 0]} for agent in "ab"]
    acts = [learner.targets[agent].act(part, 1.0)[0] for agent, part in zip("ab", observations, strict=True)]
    following = learner.targets[critic_name("a")](observations, [acts[0], acts[1] * stays])
    assert torch.allclose(targets, rows["rewards/a"][:, 0] + GAMMA * following)
    of_second = learner._targets("b", batch, [learner._critic_agents(AgentSlot("b", 0))])
    ended = rows["terminated/b"][:, 0]
    # There is no bootstrap after termination.
    torch.testing.assert_close(of_second[ended], rows["rewards/b"][:, 0][ended])


def test_a_restored_learner_has_the_learning_rate_of_its_own_settings(tmp_path: Path) -> None:
    league = maddpg("summing", {"ends": 2}, OWN, lr=0.01)
    learner_of(league).save_to_path(tmp_path / "state")
    restored = learner_of(league.with_training(lr=0.002))
    restored.restore_from_path(tmp_path / "state")
    rates = {name: restored.get_optimizer(module_id=name).param_groups[0]["lr"] for name in restored.networks}
    assert rates == dict.fromkeys(("a", "b", critic_name("a"), critic_name("b")), 0.002)


@pytest.mark.parametrize("critic", ["centralised", "own"])
def test_each_network_has_its_own_optimizer_and_loss(critic: str) -> None:
    league = maddpg("summing", {}, OWN, critic=critic)
    learner, sample = learner_of(league), sample_transitions(league)
    networks = {"a", "b", "a.critic", "b.critic"}
    assert set(learner._named_optimizers) == {f"{name}_{DEFAULT_OPTIMIZER}" for name in networks}
    for name, network in learner.networks.items():
        groups = learner._named_optimizers[f"{name}_{DEFAULT_OPTIMIZER}"].param_groups
        assert [id(p) for group in groups for p in group["params"]] == [id(p) for p in network.parameters()]
    before = {name: weights(network) for name, network in learner.networks.items()}
    learner.learn({JOINT: sample}, ["a"])
    moved = {name for name, network in learner.networks.items() if not are_equal(before[name], weights(network))}
    assert moved == {"a", "a.critic"}, "frozen policies and their critics do not change"
    rows = learner.batch(sample).rows
    order = [learner._critic_agents(AgentSlot("a", 0))]
    observations, actions = learner._critic_inputs(rows, order)
    for name, loss in (
        ("a.critic", critic_loss(learner.networks["a.critic"](observations, actions), torch.zeros(len(actions[0])))),
        ("a", learner.policy_loss("a", observations, actions, torch.ones(len(actions[0])))),
    ):
        before = {key: weights(network) for key, network in learner.networks.items()}
        learner.gradient_step(loss, [name])
        assert {key for key, net in learner.networks.items() if not are_equal(before[key], weights(net))} == {name}


def test_an_actor_step_increases_the_value_of_its_critic() -> None:
    league = maddpg("summing", {}, OWN, lr=0.001, regularization=0)
    learner, sample = learner_of(league), sample_transitions(league)
    observations, actions = learner._critic_inputs(
        learner.batch(sample).rows, [learner._critic_agents(AgentSlot("a", 0))]
    )
    everyone = torch.ones(len(actions[0]))
    losses = []
    for _ in range(10):
        loss = learner.policy_loss("a", observations, actions, everyone)
        losses.append(loss.item())
        learner.gradient_step(loss, ["a"])
    assert all(after < before for before, after in itertools.pairwise(losses)), losses


def learned(league: LeagueConfig, sample: Sample, learning: Sequence[str]) -> list[torch.Tensor]:
    """The weights of all networks of a new learner after a step."""
    learner = learner_of(league)
    learner.learn({JOINT: sample}, learning)
    return [parameter for network in learner.networks.values() for parameter in weights(network)]


def test_independent_critics_ignore_other_agents() -> None:
    sample = sample_transitions(maddpg("summing", {}, OWN))
    other = Sample(dict(sample.rows), sample.indices, sample.weights)
    for name in ("observations/b/observation", "actions/b", "next_observations/b/observation"):
        other.rows[name] = other.rows[name] + np.float32(1)
    for critic, differs in (("own", False), ("centralised", True)):
        league = maddpg("summing", {}, OWN, critic=critic)
        assert are_equal(*(learned(league, part, ["a"]) for part in (sample, other))) != differs


def test_rows_of_absent_agents_are_ignored() -> None:
    league = maddpg("summing", {"ends": 2}, OWN)
    sample = sample_transitions(league)
    absent = ~sample.rows["present/b"]
    assert absent.any()
    other = Sample({name: column.copy() for name, column in sample.rows.items()}, sample.indices, sample.weights)
    for name in ("actions/b", "rewards/b"):
        other.rows[name][absent] = 9.0
    assert are_equal(*(learned(league, twice(part), ["a", "b"]) for part in (sample, other)))


def test_agents_that_share_a_policy_are_first_in_turn() -> None:
    policies = {"pair": ["player_0", "player_2"], "single": ["player_1"]}
    learner = learner_of(maddpg("discrete", {"agents": 3}, policies))
    first, second, single = AgentSlot("pair", 0), AgentSlot("pair", 1), AgentSlot("single", 0)
    assert [learner._critic_agents(place) for place in (first, second, single)] == [
        [first, second, single],
        [second, first, single],
        [single, first, second],
    ]
    sample = sample_transitions(maddpg("discrete", {"agents": 3}, policies))
    rows = learner.batch(sample).rows
    observations, actions = learner._critic_inputs(
        rows, [learner._critic_agents(first), learner._critic_agents(second)]
    )
    k = len(sample.indices)
    tasks = rows["observations/pair/observation"]
    assert torch.equal(observations[0]["observation"], torch.cat([tasks[:, 0], tasks[:, 1]]))
    assert torch.equal(observations[1]["observation"], torch.cat([tasks[:, 1], tasks[:, 0]]))
    assert torch.equal(observations[2]["observation"], rows["observations/single/observation"][:, 0].repeat(2))
    assert torch.equal(actions[0][:k].argmax(-1), rows["actions/pair"][:, 0])
    assert torch.equal(actions[0][k:].argmax(-1), rows["actions/pair"][:, 1])
    errors = learner.learn({JOINT: twice(sample)}, ["pair", "single"])
    assert errors[JOINT].shape == (2 * k,)


def test_targets_follow_by_polyak_averaging() -> None:
    league = maddpg("summing", {}, OWN)
    learner, sample = learner_of(league), sample_transitions(league)
    before = {name: weights(target) for name, target in learner.targets.items()}
    learner.learn({JOINT: twice(sample)}, ["a", "b"])
    assert set(before) == set(learner.networks)
    for name, network in learner.networks.items():
        for old, new, target in zip(before[name], weights(network), weights(learner.targets[name]), strict=True):
            assert torch.allclose(target, 0.99 * old + 0.01 * new, atol=1e-6)


def test_running_statistics_reach_actors_critics_and_targets() -> None:
    league = maddpg("summing", {}, OWN, normalize_observations=True)
    learner, sample = learner_of(league), sample_transitions(league)
    learner.learn({JOINT: twice(sample)}, ["a", "b"])
    mean = sample.rows["observations/a/observation"].mean()
    for network in (*learner.networks.values(), *learner.targets.values()):
        assert any(name.endswith("mean") for name, _ in network.named_buffers())
    (statistic,) = (buffer for name, buffer in learner.targets["a"].named_buffers() if name.endswith("mean"))
    assert float(statistic) == pytest.approx(float(mean), abs=1e-5)
