"""The runner on an environment whose observations identify agent, turn and reset."""

import time
from collections import defaultdict
from collections.abc import Iterable

import numpy as np
import pytest
from ray.rllib.algorithms.ppo.torch.ppo_torch_learner import PPOTorchLearner
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.evaluation.postprocessing import Postprocessing
from ray.rllib.utils.metrics import (
    WEIGHTS_SEQ_NO,
)

from league.config.league import LeagueConfig
from league.environments.building import interface
from tests.conformance.stepping import plain_loop
from tests.support.environments.counting import Counting
from tests.support.leagues.training_leagues import counting, tictactoe
from training.algorithms.rllib_config import algorithm_config
from training.learners.train_batch import train_batch
from training.runs.trial import build_algorithm
from training.sampling.env_runner import IDLE_SECONDS, SAMPLING_SECONDS, BatchedEnvRunner
from training.sampling.episode_chunks import as_episodes

LIVES = [4, 6]


def runner_of(league: LeagueConfig) -> BatchedEnvRunner:
    config = algorithm_config(league, interface(league))
    return BatchedEnvRunner(config, worker_index=0)


def by_episode(chunks: Iterable[SingleAgentEpisode]) -> dict[tuple[int, int], list[SingleAgentEpisode]]:
    """(agent, seed modulo 97) → the chunks of its episode, in order."""
    episodes = defaultdict(list)
    for chunk in chunks:
        agent, _, seed = chunk.observations.data["observation"][0].astype(int)
        episodes[agent, seed].append(chunk)
    return {key: sorted(parts, key=lambda chunk: chunk.t_started) for key, parts in episodes.items()}


@pytest.mark.parametrize(("per_call", "truncated"), [(1, [0]), (7, [1]), (60, []), (60, [0, 1])], ids=str)
def test_chunks_equal_the_plain_loop(per_call: int, truncated: list[int]) -> None:
    """Observations, summed rewards and endings, for any fragment length."""
    runner = runner_of(counting(LIVES, truncated))
    chunks = [chunk for _ in range(-(-180 // per_call)) for chunk in runner.sample(num_timesteps=per_call)]
    ended = 0
    for (agent, seed), parts in by_episode(chunks).items():
        env = Counting(tuple(LIVES), tuple(truncated))
        reports = plain_loop(env, seed)[f"player_{agent}"]
        turns = [report[1]["observation"] for report in reports]
        steps = 0
        for chunk in parts:
            stop = steps + len(chunk) + 1
            assert (chunk.t_started, chunk.agent_id, chunk.module_id) == (steps, f"player_{agent}", f"policy_{agent}")
            np.testing.assert_array_equal(chunk.observations.data["observation"], turns[steps:stop])
            assert chunk.rewards.data.tolist() == [report[2] for report in reports[steps + 1 : stop]]
            steps += len(chunk)
            is_last = steps == LIVES[agent]
            assert chunk.is_terminated == (is_last and agent not in truncated)
            assert chunk.is_truncated == (is_last and agent in truncated)
            ended += is_last
    assert ended > 10


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


def test_rllibs_learner_accepts_the_episodes_and_agrees_on_value_targets() -> None:
    """One agent is truncated, the other one terminates."""
    league = counting(LIVES, [0])
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
        for column, values in (
            (Columns.ACTIONS, batch.actions),
            (Columns.ACTION_LOGP, batch.log_p),
            (Postprocessing.VALUE_TARGETS, batch.targets),
        ):
            expected = theirs[policy][column][kept].numpy()
            np.testing.assert_allclose(values.numpy(), expected, rtol=1e-3, atol=1e-3)
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
