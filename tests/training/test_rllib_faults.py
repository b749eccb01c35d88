"""Known faults of RLlib 2.60, and the correct behaviour here: one test per fault.

The code after a comment with UPSTREAM demonstrates the fault in RLlib: if it fails after an upgrade, the fault was
fixed.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from mpe2 import simple_spread_v3
from pettingzoo.classic import tictactoe_v3
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core import COMPONENT_RL_MODULE
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv, PettingZooEnv
from ray.rllib.policy.sample_batch import MultiAgentBatch, SampleBatch
from ray.rllib.utils.metrics import WEIGHTS_SEQ_NO
from ray.rllib.utils.minibatch_utils import MiniBatchCyclicIterator
from ray.tune.registry import register_env

from league.config.league import LeagueConfig
from league.environments.building import interface
from tests.support.environments.counting import Counting
from tests.support.environments.simultaneous import Simultaneous
from tests.support.leagues.training_leagues import counting, solvable, tictactoe
from training.algorithms.rllib_config import algorithm_config
from training.learners.train_batch import minibatches, train_batch
from training.modules.actor_critic import ActorCritic
from training.rllib_compat import EpisodeChunk
from training.runs.trial import build_algorithm
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.rllib_env import LeagueEnv

pytestmark = pytest.mark.usefixtures("ray_session")

CYCLES = 5
MEETING = "tests.support.environments.simultaneous:meeting"


def spread() -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": CYCLES}},
            "training": {"runners": 0, "num_envs": 2, "hidden": [8]},
        }
    )


def meeting(**kwargs: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "meeting",
            "environment": {"entry_point": MEETING, "kwargs": kwargs},
            "policies": {"policy_0": ["agent_0"], "policy_1": ["agent_1"]},
            "training": {"runners": 0, "num_envs": 2, "hidden": [8]},
        }
    )


def our_runner(league: LeagueConfig, index: int = 0) -> BatchedEnvRunner:
    return BatchedEnvRunner(algorithm_config(league, interface(league)), worker_index=index)


def rllib_runner(make: Any, agents: list[str], **env_runners: Any) -> MultiAgentEnvRunner:
    """RLlib's runner on one of its wrappers, with a policy per agent."""
    register_env("upstream", lambda _: make())
    config = PPOConfig().environment("upstream").debugging(seed=1)
    config.env_runners(num_env_runners=0, **env_runners)
    config.multi_agent(policies=set(agents), policy_mapping_fn=lambda agent, *_, **__: agent)
    return MultiAgentEnvRunner(config=config, worker_index=0)


def test_1_truncated_agents_are_not_terminated_and_are_bootstrapped() -> None:
    runner = our_runner(spread())
    (chunks,) = runner.sample_chunks(num_episodes=4)
    ended = np.flatnonzero(chunks.truncated)
    assert len(ended) == 12
    assert not chunks.terminated.any()
    module = runner.config.get_multi_rl_module_spec(spaces=runner.get_spaces()).build()["shared"]
    last = int(chunks.lengths[: ended[0] + 1].sum()) - 1
    target = float(train_batch(module, [chunks], gamma=0.5, lambda_=1.0).targets[last])
    # Each chunk has one observation more than steps.
    final = torch.from_numpy(chunks.observations["observation"][[last + ended[0] + 1]])
    value = float(module.compute_values({"obs": {"observation": final}}).detach())
    assert value != 0
    assert target == pytest.approx(chunks.rewards[last] + 0.5 * value, rel=1e-4)

    # UPSTREAM env/multi_agent_episode.py, "Case 2": the bootstrap is 0.
    env = simple_spread_v3.parallel_env(max_cycles=CYCLES)
    upstream = rllib_runner(lambda: ParallelPettingZooEnv(env), env.possible_agents).sample(num_episodes=1)
    assert all(agent.is_terminated for agent in upstream[0].agent_episodes.values())


def test_2_an_episode_with_terminated_and_truncated_agents_ends() -> None:
    chunks = our_runner(meeting(truncated=[1])).sample(num_episodes=2)
    ends = Counter((chunk.agent_id, chunk.is_terminated, chunk.is_truncated) for chunk in chunks if chunk.is_done)
    assert ends == {("agent_0", True, False): 2, ("agent_1", False, True): 2}
    wrapper = LeagueEnv(meeting(truncated=[1]))
    wrapper.reset(seed=0)
    for _ in range(3):
        _, _, terminated, truncated, _ = wrapper.step({"agent_0": 0, "agent_1": 0})
    assert truncated["__all__"]
    assert not terminated["__all__"]

    # UPSTREAM env/wrappers/pettingzoo_env.py: neither flag is set, and the episode never ends.
    env = ParallelPettingZooEnv(Simultaneous(truncated=[1]))
    env.reset(seed=0)
    for _ in range(3):
        _, _, terminated, truncated, _ = env.step({"agent_0": 0, "agent_1": 0})
    assert not terminated["__all__"]
    assert not truncated["__all__"]


def recorded_resets(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    seeds: list[int] = []
    reset = Counting.reset

    def recording(self: Counting, seed: int | None = None, options: Any = None) -> None:
        seeds.append(-1 if seed is None else seed)
        reset(self, seed, options)

    monkeypatch.setattr(Counting, "reset", recording)
    return seeds


def test_3_no_seed_is_used_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """Across runners, environments, episodes, samples and restarts."""
    league = counting([2, 2], [], runners=2, num_envs=3)
    runners = [our_runner(league, index) for index in (1, 2)]
    seeds = recorded_resets(monkeypatch)
    steps = 0
    for _ in range(3):
        for runner in runners:
            runner.reset_episodes(steps)
        for _ in range(2):
            for runner in runners:
                runner.sample(num_episodes=5)
        steps += sum(runner.get_metrics()["num_env_steps_sampled"].peek() for runner in runners)
    assert len(seeds) > 60
    assert len(set(seeds)) == len(seeds)
    assert -1 not in seeds

    # UPSTREAM env/multi_agent_env_runner.py: complete episodes always start with the seed of the runner.
    upstream = rllib_runner(lambda: PettingZooEnv(Counting()), ["player_0", "player_1"], batch_mode="complete_episodes")
    seeds.clear()
    for _ in range(3):
        upstream.sample(num_episodes=1)
    assert max(Counter(seed for seed in seeds if seed >= 0).values()) == 3


def test_4_the_environment_renders() -> None:
    wrapper = LeagueEnv(spread(), render_mode="rgb_array")
    wrapper.reset(seed=0)
    assert wrapper.render().shape[2] == 3

    # UPSTREAM env/wrappers/pettingzoo_env.py: passes an argument that PettingZoo does not accept.
    for env in (
        ParallelPettingZooEnv(simple_spread_v3.parallel_env(render_mode="rgb_array")),
        PettingZooEnv(simple_spread_v3.env(render_mode="rgb_array")),
    ):
        env.reset()
        with pytest.raises(TypeError):
            env.render()


def test_5_each_step_is_learned_from_once_per_epoch() -> None:
    """One policy has 1 step for 15 of the other, as in a league with rarely chosen opponents."""
    few, many, epochs = 10, 150, 3
    league = meeting(leaves=[few, many])
    runner = our_runner(league.with_training(num_envs=1))
    batches = {
        chunks.policy: train_batch(
            runner.config.get_multi_rl_module_spec(spaces=runner.get_spaces()).build()[chunks.policy],
            [chunks],
            gamma=0.9,
            lambda_=0.9,
        )
        for chunks in runner.sample_chunks(num_episodes=1)
    }
    seen: Counter[str] = Counter()
    for minibatch in minibatches(batches, size=20, epochs=epochs):
        seen.update({policy: len(steps.actions) for policy, steps in minibatch.items()})
    assert seen == {"policy_0": epochs * few, "policy_1": epochs * many}

    # UPSTREAM utils/minibatch_utils.py: minibatches have one size for all policies, hence 15 times the epochs for the
    # small one.
    columns = {"policy_0": few, "policy_1": many}
    batch = MultiAgentBatch({policy: SampleBatch({"obs": np.zeros(rows)}) for policy, rows in columns.items()}, many)
    iterator = MiniBatchCyclicIterator(batch, num_epochs=epochs, minibatch_size=10)
    assert sum(len(part.policy_batches["policy_0"]) for part in iterator) == 15 * epochs * few


def test_6_weights_of_a_module_that_is_added_later_are_applied() -> None:
    """With the WEIGHTS_SEQ_NO of the weights that the runner already has (ray#61960)."""

    def arrives(runner: Any, spec: RLModuleSpec, name: str) -> bool:
        weights = runner.get_state(COMPONENT_RL_MODULE)[COMPONENT_RL_MODULE]
        runner.set_state({COMPONENT_RL_MODULE: weights, WEIGHTS_SEQ_NO: 3})
        runner.module.add_module("snapshot", spec.build())
        snapshot = spec.build().get_state()
        runner.set_state({COMPONENT_RL_MODULE: {**weights, "snapshot": snapshot}, WEIGHTS_SEQ_NO: 3})
        assert name in snapshot
        return np.array_equal(runner.module["snapshot"].get_state()[name], snapshot[name])

    runner = our_runner(tictactoe())
    observation, action = runner.get_spaces()["shared"]
    spec = RLModuleSpec(
        module_class=ActorCritic, observation_space=observation, action_space=action, model_config={"hidden": [4]}
    )
    assert arrives(runner, spec, "policy_head.weight")

    # UPSTREAM env/multi_agent_env_runner.py: one number for all modules, which has not increased.
    register_env("upstream", lambda _: PettingZooEnv(tictactoe_v3.env()))
    config = PPOConfig().environment("upstream").env_runners(num_env_runners=0)
    config.multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"shared": spec}))
    assert not arrives(MultiAgentEnvRunner(config=config, worker_index=0), spec, "policy_head.weight")


class Reporting(Counting):
    """Player 1 is absent at the reset, which returns infos."""

    def reset(self, seed: int | None = None, options: Any = None) -> None:
        super().reset(seed, options)
        self.agents = self.agents[:1]
        self.infos["player_0"] = {"seed": seed}


def reporting() -> Reporting:
    return Reporting()


def test_7_infos_of_resets_agents_and_their_order_are_kept() -> None:
    league = LeagueConfig.from_mapping(
        {
            "league": "reporting",
            "environment": {"entry_point": f"{__name__}:reporting"},
            "policies": {"a": ["player_0"], "b": ["player_1"]},
        }
    )
    wrapper = LeagueEnv(league)
    assert wrapper.possible_agents == ["player_0", "player_1"]
    assert list(wrapper.observation_spaces) == wrapper.possible_agents
    assert wrapper.reset(seed=4)[1] == {"player_0": {"seed": 4}}

    # UPSTREAM env/wrappers/pettingzoo_env.py
    env = PettingZooEnv(Reporting())
    assert set(env.possible_agents) == {"player_0"}
    assert env.reset(seed=4)[1] == {}


# Fault 8 concerns RLlib's exploration in DQN, which is not used here.


def test_9_a_restored_algorithm_continues_identically(tmp_path: Path) -> None:
    """Weights, optimizer and random states: three more updates give the same bits."""
    league = solvable("discrete", {"agents": 2, "opposed": True}, train_batch_size=64, minibatch_size=32, epochs=2)

    def weights(algorithm: Any) -> dict[str, np.ndarray]:
        return algorithm.learner_group._learner.module["shared"].get_state()

    algorithm = build_algorithm(league, interface(league))
    try:
        steps = 64 * 2
        algorithm.reset_episodes(0)
        for _ in range(2):
            algorithm.train()
        algorithm.save_to_path(str(tmp_path / "state"))
        algorithm.reset_episodes(steps)
        for _ in range(3):
            algorithm.train()
        expected = weights(algorithm)
    finally:
        algorithm.stop()
    torch.manual_seed(12345)
    restored = build_algorithm(league, interface(league), tmp_path / "state")
    try:
        restored.reset_episodes(steps)
        for _ in range(3):
            restored.train()
        found = weights(restored)
    finally:
        restored.stop()
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)

    # UPSTREAM algorithms/ppo/ppo_learner.py: the adaptive coefficient of the KL term is in no state.
    spaces = {"default_policy": (gymnasium.spaces.Box(-1, 1, (2,)), gymnasium.spaces.Discrete(2))}
    learned, fresh = (PPOConfig().build_learner(spaces=spaces) for _ in range(2))
    learned.curr_kl_coeffs_per_module["default_policy"].data.fill_(7.0)
    fresh.set_state(learned.get_state())
    assert float(fresh.curr_kl_coeffs_per_module["default_policy"]) == pytest.approx(0.2)


def test_10_each_chunk_is_created_once(monkeypatch: pytest.MonkeyPatch) -> None:
    created = 0
    construct = EpisodeChunk.__init__

    def counting_chunks(self: EpisodeChunk, *args: Any, **kwargs: Any) -> None:
        nonlocal created
        created += 1
        construct(self, *args, **kwargs)

    monkeypatch.setattr(EpisodeChunk, "__init__", counting_chunks)
    assert len(our_runner(counting([3, 3], [])).sample(num_timesteps=600)) == created > 150

    # UPSTREAM env/multi_agent_env_runner.py: at each step, all finished episodes are converted again.
    converted = 0
    to_numpy = MultiAgentEpisode.to_numpy

    def counting_conversions(self: MultiAgentEpisode) -> MultiAgentEpisode:
        nonlocal converted
        converted += 1
        return to_numpy(self)

    upstream = rllib_runner(lambda: PettingZooEnv(Counting((3, 3))), ["player_0", "player_1"])
    monkeypatch.setattr(MultiAgentEpisode, "to_numpy", counting_conversions)
    episodes = upstream.sample(num_timesteps=120)
    assert converted > 5 * len(episodes)
