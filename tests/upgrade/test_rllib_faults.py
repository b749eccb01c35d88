"""Faults of RLlib 2.60, for which training has code of its own. If a test fails, an upgrade has fixed the fault."""

from collections import Counter
from typing import Any

import gymnasium
import numpy as np
import pytest
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

from tests.support.environments.counting import Counting
from tests.support.environments.simultaneous import Simultaneous
from training.modules.actor_critic import ActorCritic

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("ray_session")]


def runner(make: Any, agents: list[str], **env_runners: Any) -> MultiAgentEnvRunner:
    """RLlib's runner on one of its wrappers, with a policy per agent."""
    register_env("upstream", lambda _: make())
    config = PPOConfig().environment("upstream").debugging(seed=1)
    config.env_runners(num_env_runners=0, **env_runners)
    config.multi_agent(policies=set(agents), policy_mapping_fn=lambda agent, *_, **__: agent)
    return MultiAgentEnvRunner(config=config, worker_index=0)


def test_the_bootstrap_of_truncated_agents_is_0() -> None:
    """env/multi_agent_episode.py, "Case 2"."""
    env = simple_spread_v3.parallel_env(max_cycles=5)
    (episode,) = runner(lambda: ParallelPettingZooEnv(env), env.possible_agents).sample(num_episodes=1)
    assert all(agent.is_terminated for agent in episode.agent_episodes.values())


def test_an_episode_with_terminated_and_truncated_agents_never_ends() -> None:
    """env/wrappers/pettingzoo_env.py: neither flag is set."""
    env = ParallelPettingZooEnv(Simultaneous(truncated=[1]))
    env.reset(seed=0)
    for _ in range(3):
        _, _, terminated, truncated, _ = env.step({"agent_0": 0, "agent_1": 0})
    assert not terminated["__all__"]
    assert not truncated["__all__"]


def test_complete_episodes_always_start_with_the_seed_of_the_runner(monkeypatch: pytest.MonkeyPatch) -> None:
    """env/multi_agent_env_runner.py."""
    seeds: list[int | None] = []
    reset = Counting.reset

    def recorded(self: Counting, seed: int | None = None, options: Any = None) -> None:
        seeds.append(seed)
        reset(self, seed, options)

    monkeypatch.setattr(Counting, "reset", recorded)
    upstream = runner(lambda: PettingZooEnv(Counting()), ["player_0", "player_1"], batch_mode="complete_episodes")
    seeds.clear()
    for _ in range(3):
        upstream.sample(num_episodes=1)
    assert max(Counter(seed for seed in seeds if seed is not None).values()) == 3


def test_environments_cannot_be_rendered() -> None:
    """env/wrappers/pettingzoo_env.py passes an argument that PettingZoo does not accept."""
    for env in (
        ParallelPettingZooEnv(simple_spread_v3.parallel_env(render_mode="rgb_array")),
        PettingZooEnv(simple_spread_v3.env(render_mode="rgb_array")),
    ):
        env.reset()
        with pytest.raises(TypeError):
            env.render()


def test_minibatches_have_one_size_for_all_policies() -> None:
    """utils/minibatch_utils.py: hence 15 times the epochs for a policy with a fifteenth of the steps."""
    columns = {"policy_0": 10, "policy_1": 150}
    batch = MultiAgentBatch({policy: SampleBatch({"obs": np.zeros(rows)}) for policy, rows in columns.items()}, 150)
    iterator = MiniBatchCyclicIterator(batch, num_epochs=3, minibatch_size=10)
    assert sum(len(part.policy_batches["policy_0"]) for part in iterator) == 15 * 3 * 10


def test_weights_of_a_module_that_is_added_later_are_ignored() -> None:
    """env/multi_agent_env_runner.py: one number for all modules, which has not increased (ray#61960)."""
    register_env("upstream", lambda _: PettingZooEnv(tictactoe_v3.env()))
    spaces = tictactoe_v3.env()
    spec = RLModuleSpec(
        module_class=ActorCritic,
        observation_space=spaces.observation_space("player_1"),
        action_space=spaces.action_space("player_1"),
        model_config={"hidden": [4]},
    )
    config = PPOConfig().environment("upstream").env_runners(num_env_runners=0)
    config.multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"shared": spec}))
    upstream = MultiAgentEnvRunner(config=config, worker_index=0)
    weights = upstream.get_state(COMPONENT_RL_MODULE)[COMPONENT_RL_MODULE]
    upstream.set_state({COMPONENT_RL_MODULE: weights, WEIGHTS_SEQ_NO: 3})
    upstream.module.add_module("snapshot", spec.build())
    snapshot = spec.build().get_state()
    upstream.set_state({COMPONENT_RL_MODULE: {**weights, "snapshot": snapshot}, WEIGHTS_SEQ_NO: 3})
    name = "policy_head.weight"
    assert not np.array_equal(upstream.module["snapshot"].get_state()[name], snapshot[name])


def test_infos_of_resets_and_agents_are_lost() -> None:
    """env/wrappers/pettingzoo_env.py."""

    class Reporting(Counting):
        def reset(self, seed: int | None = None, options: Any = None) -> None:
            super().reset(seed, options)
            self.agents = self.agents[:1]
            self.infos["player_0"] = {"seed": seed}

    env = PettingZooEnv(Reporting())
    assert set(env.possible_agents) == {"player_0"}
    assert env.reset(seed=4)[1] == {}


def test_the_adaptive_coefficient_of_the_kl_term_is_in_no_state() -> None:
    """algorithms/ppo/ppo_learner.py."""
    spaces = {"default_policy": (gymnasium.spaces.Box(-1, 1, (2,)), gymnasium.spaces.Discrete(2))}
    learned, fresh = (PPOConfig().build_learner(spaces=spaces) for _ in range(2))
    learned.curr_kl_coeffs_per_module["default_policy"].data.fill_(7.0)
    fresh.set_state(learned.get_state())
    assert float(fresh.curr_kl_coeffs_per_module["default_policy"]) == pytest.approx(0.2)


def test_finished_episodes_are_converted_at_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """env/multi_agent_env_runner.py."""
    converted = 0
    to_numpy = MultiAgentEpisode.to_numpy

    def counting_conversions(self: MultiAgentEpisode) -> MultiAgentEpisode:
        nonlocal converted
        converted += 1
        return to_numpy(self)

    upstream = runner(lambda: PettingZooEnv(Counting((3, 3))), ["player_0", "player_1"])
    monkeypatch.setattr(MultiAgentEpisode, "to_numpy", counting_conversions)
    episodes = upstream.sample(num_timesteps=120)
    assert converted > 5 * len(episodes)
