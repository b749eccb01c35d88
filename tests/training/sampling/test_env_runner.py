"""The runner on an environment whose observations identify agent, turn and reset."""

import time
from collections import defaultdict
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.evaluation.postprocessing import Postprocessing
from ray.rllib.utils.metrics import (
    EPISODE_LEN_MEAN,
    EPISODE_MODULE_RETURN_MEAN,
    NUM_ENV_STEPS_SAMPLED,
    NUM_EPISODES,
    NUM_MODULE_STEPS_SAMPLED,
    WEIGHTS_SEQ_NO,
)

from league.config.league import LeagueConfig
from league.environments.building import interface
from tests.conformance.stepping import plain_loop
from tests.support.environments.counting import Counting
from tests.support.leagues.training_leagues import counting, tictactoe
from training.algorithms.rllib_config import algorithm_config
from training.learners.train_batch import train_batch
from training.rllib_compat import EpisodeChunk
from training.runs.trial import build_algorithm
from training.sampling.env_runner import IDLE_SECONDS, SAMPLING_SECONDS, BatchedEnvRunner
from training.sampling.episode_chunks import as_episodes
from training.sampling.play_metrics import ENTROPY

LIVES = [4, 6]
CASES = ([], [0], [1], [0, 1])


def runner_of(league: LeagueConfig) -> BatchedEnvRunner:
    config = algorithm_config(league, interface(league))
    return BatchedEnvRunner(config, worker_index=0)


def by_episode(chunks: Iterable[SingleAgentEpisode]) -> dict[tuple[int, int], list[SingleAgentEpisode]]:
    """(agent, seed modulo 97) → the chunks of its episode, in order."""
    episodes = defaultdict(list)
    for chunk in chunks:
        agent, _, seed = chunk.observations.data["observation"][0].astype(int)
        episodes[agent, seed].append(chunk)
    return {key: sorted(found, key=lambda chunk: chunk.t_started) for key, found in episodes.items()}


@pytest.mark.parametrize("truncated", CASES, ids=str)
@pytest.mark.parametrize("per_call", [1, 7, 60])
def test_chunks_equal_the_plain_loop(truncated: list[int], per_call: int) -> None:
    """Observations, summed rewards and endings, for any fragment length."""
    runner = runner_of(counting(LIVES, truncated))
    chunks = [chunk for _ in range(-(-180 // per_call)) for chunk in runner.sample(num_timesteps=per_call)]
    ended = 0
    for (agent, seed), found in by_episode(chunks).items():
        env = Counting(tuple(LIVES), tuple(truncated))
        reports = plain_loop(env, seed)[f"player_{agent}"]
        turns = [report[1]["observation"] for report in reports]
        steps = 0
        for chunk in found:
            assert chunk.t_started == steps
            assert chunk.agent_id == f"player_{agent}"
            assert chunk.module_id == f"policy_{agent}"
            assert chunk.observations.data["observation"].tolist() == [
                turn.tolist() for turn in turns[steps : steps + len(chunk) + 1]
            ]
            expected = [report[2] for report in reports[steps + 1 : steps + 1 + len(chunk)]]
            assert chunk.rewards.data.tolist() == expected
            steps += len(chunk)
            is_last = steps == LIVES[agent]
            assert chunk.is_terminated == (is_last and agent not in truncated)
            assert chunk.is_truncated == (is_last and agent in truncated)
            ended += is_last
    assert ended > 10


def test_openings_are_played_but_not_learned_from() -> None:
    """Episodes start at any step of the opening; all later steps are recorded."""
    runner = runner_of(counting(LIVES, [], opening_plies=5))
    chunks = [chunk for _ in range(6) for chunk in runner.sample(num_timesteps=51)]
    firsts = set()
    for (agent, seed), found in by_episode(chunks).items():
        reports = plain_loop(Counting(tuple(LIVES)), seed)[f"player_{agent}"]
        first = int(found[0].observations.data["observation"][0][1])
        firsts.add((agent, first))
        rewards = [reward for chunk in found for reward in chunk.rewards.data.tolist()]
        assert rewards == [report[2] for report in reports[first + 1 : first + 1 + len(rewards)]]
        assert found[-1].is_terminated == (first + len(rewards) == LIVES[agent])
    assert firsts == {(0, 0), (0, 1), (0, 2), (0, 3), (1, 0), (1, 1), (1, 2)}
    metrics = runner.get_metrics()
    assert metrics[NUM_ENV_STEPS_SAMPLED].peek() == 306
    assert sum(stat.peek() for stat in metrics[NUM_MODULE_STEPS_SAMPLED].values()) < 306


def test_each_chunk_is_created_once_and_has_a_unique_id(monkeypatch: pytest.MonkeyPatch) -> None:
    """RLlib's runner converts all finished episodes again at each step."""
    runner = runner_of(counting(LIVES, []))
    created: list[EpisodeChunk] = []
    construct = EpisodeChunk.__init__

    def recorded(self: EpisodeChunk, *arguments: Any, **options: Any) -> None:
        created.append(self)
        construct(self, *arguments, **options)

    monkeypatch.setattr(EpisodeChunk, "__init__", recorded)
    chunks = [chunk for _ in range(30) for chunk in runner.sample(num_timesteps=5)]
    for ids in ([chunk.id_ for chunk in chunks], [chunk.multi_agent_episode_id for chunk in chunks]):
        assert len(set(ids)) == len(chunks) == len(created)


def test_log_probabilities_belong_to_the_actions_and_observations() -> None:
    runner = runner_of(tictactoe())
    for chunk in (chunk for _ in range(5) for chunk in runner.sample(num_timesteps=33)):
        observations = {name: torch.from_numpy(array[:-1].copy()) for name, array in chunk.observations.data.items()}
        out = runner.module["shared"].forward_exploration({Columns.OBS: observations})
        logits = out[Columns.ACTION_DIST_INPUTS]
        actions = torch.from_numpy(chunk.actions.data.copy())
        expected = torch.log_softmax(logits, -1).gather(1, actions[:, None]).squeeze(1)
        extra = chunk.extra_model_outputs
        np.testing.assert_allclose(extra[Columns.ACTION_DIST_INPUTS].data, logits.numpy(), atol=1e-5)
        np.testing.assert_allclose(extra[Columns.ACTION_LOGP].data, expected.numpy(), atol=1e-5)


def test_metrics_count_the_played_steps() -> None:
    runner = runner_of(counting(LIVES, []))
    runner.sample(num_timesteps=300)
    metrics = runner.get_metrics()
    values = {key: metrics[key].peek() for key in (NUM_ENV_STEPS_SAMPLED, NUM_EPISODES, EPISODE_LEN_MEAN)}
    assert values[NUM_ENV_STEPS_SAMPLED] == 300
    assert values[NUM_EPISODES] == 30
    assert values[EPISODE_LEN_MEAN] == sum(LIVES)
    # Player i gets 10^i for each move until its last one; moves alternate until player 0 has left.
    returns = {policy: stat.peek() for policy, stat in metrics[EPISODE_MODULE_RETURN_MEAN].items()}
    assert returns == {"policy_0": 7.0, "policy_1": 100.0}
    steps = {policy: stat.peek() for policy, stat in metrics[NUM_MODULE_STEPS_SAMPLED].items()}
    assert sum(steps.values()) == 300
    assert 0 < metrics["policy_0"][ENTROPY].peek() <= np.log(2) + 1e-6
    assert runner.get_metrics()[NUM_ENV_STEPS_SAMPLED].peek() == 0


def test_each_reset_has_its_own_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    seeds: list[int] = []
    reset = Counting.reset

    def recording(self: Counting, seed: int | None = None, options: None = None) -> None:
        seeds.append(seed)
        reset(self, seed, options)

    monkeypatch.setattr(Counting, "reset", recording)
    league = counting(LIVES, [], runners=2)
    config = algorithm_config(league, interface(league))
    for index in (1, 2):
        runner = BatchedEnvRunner(config, worker_index=index)
        for _ in range(3):
            runner.sample(num_timesteps=300, force_reset=True)
    assert len(seeds) > 180
    assert len(set(seeds)) == len(seeds)


def test_the_seed_determines_the_play() -> None:
    def play(seed: int) -> list[list[int]]:
        torch.manual_seed(0)
        runner = runner_of(tictactoe(seed=seed))
        return [chunk.actions.data.tolist() for chunk in runner.sample(num_timesteps=100)]

    torch.manual_seed(0)
    assert play(1) == play(1)
    assert play(1) != play(2)


def test_complete_episodes_with_greedy_and_random_play() -> None:
    runner = runner_of(tictactoe())
    assert sum(chunk.is_done for chunk in runner.sample(num_episodes=6)) >= 12
    greedy = runner.sample(num_timesteps=40, explore=False, force_reset=True)
    assert all(chunk.t_started == 0 for chunk in greedy)
    for chunk in greedy:
        logits = chunk.extra_model_outputs[Columns.ACTION_DIST_INPUTS].data
        assert chunk.actions.data.tolist() == logits.argmax(-1).tolist()
    for chunk in runner.sample(num_timesteps=200, random_actions=True, force_reset=True):
        mask = chunk.observations.data["action_mask"][:-1]
        expected = 1 / mask.sum(-1)
        logp = chunk.extra_model_outputs[Columns.ACTION_LOGP].data
        np.testing.assert_allclose(np.exp(logp), expected, rtol=1e-5)


def test_a_sample_is_never_empty() -> None:
    """Less than one move per environment closes no step: the runner continues until a step is closed."""
    chunks = runner_of(tictactoe()).sample(num_timesteps=1)
    assert sum(map(len, chunks)) >= 1


def test_newer_weights_are_applied() -> None:
    runner, other = runner_of(tictactoe()), runner_of(tictactoe(seed=9))
    weights = other.get_state(COMPONENT_RL_MODULE)[COMPONENT_RL_MODULE]

    def value() -> float:
        return float(runner.module["shared"].policy_head.weight.detach().sum())

    initial = value()
    runner.set_state({COMPONENT_RL_MODULE: weights, WEIGHTS_SEQ_NO: 3})
    newer = value()
    assert newer != initial
    old = runner_of(tictactoe(seed=10)).get_state(COMPONENT_RL_MODULE)[COMPONENT_RL_MODULE]
    runner.set_state({COMPONENT_RL_MODULE: old, WEIGHTS_SEQ_NO: 2})
    assert value() == newer
    runner.set_state({COMPONENT_RL_MODULE: old, WEIGHTS_SEQ_NO: 0})
    assert value() != newer
    assert runner.get_state()[WEIGHTS_SEQ_NO] == 3


def test_weights_of_a_module_that_is_added_later_are_applied() -> None:
    """With the WEIGHTS_SEQ_NO of the weights that the runner already has, by which RLlib ignores them (ray#61960)."""
    runner = runner_of(tictactoe())
    spec = runner.config.get_multi_rl_module_spec(spaces=runner.get_spaces()).rl_module_specs["shared"]
    weights = runner.get_state(COMPONENT_RL_MODULE)[COMPONENT_RL_MODULE]
    runner.set_state({COMPONENT_RL_MODULE: weights, WEIGHTS_SEQ_NO: 3})
    runner.module.add_module("snapshot", spec.build())
    snapshot = spec.build().get_state()
    runner.set_state({COMPONENT_RL_MODULE: {**weights, "snapshot": snapshot}, WEIGHTS_SEQ_NO: 3})
    name = "policy_head.weight"
    np.testing.assert_array_equal(runner.module["snapshot"].get_state()[name], snapshot[name])


@pytest.mark.parametrize("truncated", CASES, ids=str)
def test_rllibs_learner_accepts_the_episodes_and_agrees_on_value_targets(truncated: list[int]) -> None:
    league = counting(LIVES, truncated)
    runner = runner_of(league)
    samples = [chunks for _ in range(3) for chunks in runner.sample_chunks(num_timesteps=50)]
    episodes = [episode for chunks in samples for episode in as_episodes(chunks, runner.env.agents)]
    config = algorithm_config(league, interface(league))
    config.learners(
        learner_class=PPOTorchLearner,
        learner_connector=lambda *_: [],
        add_default_connectors_to_learner_pipeline=True,
    )
    learner = config.build_learner(spaces=runner.get_spaces())
    ours = {
        policy: train_batch(
            learner.module[policy],
            [chunks for chunks in samples if chunks.policy == policy],
            gamma=league.training.gamma,
            lambda_=league.training.lambda_,
        )
        for policy in interface(league).policy_ids
    }
    theirs = learner._learner_connector(
        rl_module=learner.module, batch={}, episodes=episodes, shared_data={}, metrics=learner.metrics
    )
    for policy, batch in ours.items():
        kept = theirs[policy][Columns.LOSS_MASK]
        for column, mine in (
            (Columns.ACTIONS, batch.actions),
            (Columns.ACTION_LOGP, batch.log_p),
            (Postprocessing.VALUE_TARGETS, batch.targets),
        ):
            expected = theirs[policy][column][kept].numpy()
            np.testing.assert_allclose(mine.numpy(), expected, rtol=1e-3, atol=1e-3)
    # RLlib's pipeline modifies the episodes.
    fresh = runner.sample(num_timesteps=50)
    assert learner.update(episodes=fresh, num_epochs=1, minibatch_size=32, timesteps={})


def test_a_runner_is_idle_between_samples_but_not_while_a_checkpoint_is_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    runner = runner_of(counting(LIVES, []))
    clock = iter([0.0, 3.0, 10.0, 12.0, 100.0, 101.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    for is_reset in (False, False, True):
        if is_reset:
            runner.reset_episodes(0)
        with runner.timed_sample():
            pass
    monkeypatch.undo()
    metrics = runner.get_metrics()
    assert (metrics[SAMPLING_SECONDS].peek(), metrics[IDLE_SECONDS].peek()) == (6.0, 7.0)
    assert runner.get_metrics()[IDLE_SECONDS].peek() == 0


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_remote_runners_have_distinct_seeds_and_the_weights_of_the_learner() -> None:
    league = tictactoe(runners=2, num_envs=2, train_batch_size=64, minibatch_size=32, epochs=1)
    algorithm = build_algorithm(league, interface(league), runner_cpus=0.5)
    try:
        for _ in range(2):
            algorithm.train()
        learner = algorithm.learner_group._learner
        expected = learner.module["shared"].get_state()
        states = algorithm.env_runner_group.foreach_env_runner(
            lambda runner: (runner.get_state(), runner._play._seeds), local_env_runner=False
        )
        for state, _ in states:
            assert state[WEIGHTS_SEQ_NO] == learner._weights_seq_no
            for name, array in state[COMPONENT_RL_MODULE]["shared"].items():
                np.testing.assert_array_equal(array, expected[name])
        used = [{seeds(env, episode) for env in range(2) for episode in range(50)} for _, seeds in states]
        assert len(used[0]) == len(used[1]) == 100
        assert not used[0] & used[1]
        algorithm.reset_episodes(128)
        started = algorithm.env_runner_group.foreach_env_runner(
            lambda runner: runner._play._seeds.steps, local_env_runner=False
        )
        assert started == [128, 128]
    finally:
        algorithm.stop()
