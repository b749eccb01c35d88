"""RLlib's runner and learner in the environment of a league."""

from typing import Any

import numpy as np
import pytest
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.multi_agent_env import MultiAgentEnv
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_LEN_MEAN, NUM_ENV_STEPS_SAMPLED

from league.config.league import LeagueConfig
from league.errors import EnvironmentMismatch, IllegalAction
from tests.support.leagues.training_leagues import COUNTING
from training.modules.actor_critic import ActorCritic
from training.sampling.rllib_env import LeagueEnv, register

MEETING = "tests.support.environments.simultaneous:meeting"


def league(entry_point: str, name: str = "together", **kwargs: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": name,
            "environment": {"entry_point": entry_point, "kwargs": kwargs},
            "policies": f"{__name__}:own_policy",
        }
    )


def own_policy(agent: str) -> str:
    """The policy with the name of the agent."""
    return agent


def episode_results(env: LeagueEnv, seed: int | None = 0) -> list[tuple[Any, ...]]:
    """The results of all steps of an episode in which each agent takes its first legal action."""
    results: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    while len(results) == 1 or not (results[-1][2]["__all__"] or results[-1][3]["__all__"]):
        observations = results[-1][0]
        assert set(env.agents) <= set(observations)
        results.append(env.step({agent: _first(observations[agent]) for agent in env.agents}))
        assert set(results[-1][0]) == set(results[-1][1])
    return results


def _first(observation: Any) -> int:
    return int(np.argmax(observation["action_mask"])) if isinstance(observation, dict) else 0


def test_agents_and_spaces_cover_all_possible_agents() -> None:
    env = LeagueEnv(league(MEETING, arrives=[0, 2], leaves=[3, 4]))
    assert isinstance(env, MultiAgentEnv)
    assert env.possible_agents == ["agent_0", "agent_1"]
    assert env.get_action_space("agent_1").n == 3
    assert list(env.reset(seed=0)[0]) == ["agent_0"]
    env.close()


@pytest.mark.parametrize(
    ("truncated", "all_terminated", "flagged"),
    [([], True, {"agent_0", "agent_1"}), ([0, 1], False, set()), ([1], False, {"agent_0"})],
    ids=["terminated", "truncated", "mixed"],
)
def test_all_agents_end_together(truncated: list[int], all_terminated: bool, flagged: set[str]) -> None:
    *earlier, last = episode_results(LeagueEnv(league(MEETING, truncated=truncated)))
    for _, _, terminated, truncations, _ in earlier[1:]:
        assert not any(terminated.values())
        assert not any(truncations.values())
    _, rewards, terminated, truncations, _ = last
    assert (terminated.pop("__all__"), truncations.pop("__all__")) == (all_terminated, not all_terminated)
    assert {agent for agent, flag in terminated.items() if flag} == flagged
    assert not any(truncations.values())
    assert rewards == {"agent_0": 1.0, "agent_1": 10.0}


def test_an_agent_that_leaves_early_has_its_own_flag() -> None:
    results = episode_results(LeagueEnv(league(MEETING, leaves=[1, 3], truncated=[0, 1])))
    assert results[1][3] == {"agent_0": True, "agent_1": False, "__all__": False}
    assert results[-1][2] == {"agent_1": False, "__all__": False}
    assert results[-1][3] == {"agent_1": False, "__all__": True}


def test_turn_based_agents_act_in_the_order_of_the_environment() -> None:
    """An agent has an observation when it must act, with the rewards since its last one, and when it leaves."""
    env = LeagueEnv(league(COUNTING, lives=[2, 3]))
    agents_to_act, rewards = [], {"player_0": 0.0, "player_1": 0.0}
    for result in episode_results(env):
        agents_to_act.append([agent for agent in result[0] if not (len(result) > 2 and result[2].get(agent))])
        for agent, reward in (result[1] if len(result) > 2 else {}).items():
            rewards[agent] += reward
    assert agents_to_act == [["player_0"], ["player_1"], ["player_0"], ["player_1"], ["player_1"], []]
    assert rewards == {"player_0": 3.0, "player_1": 50.0}


def test_action_masks_are_in_the_observations() -> None:
    env = LeagueEnv(league("pettingzoo.classic.tictactoe_v3"))
    observations, _ = env.reset(seed=0)
    assert env.observation_spaces["player_1"].contains(observations["player_1"])
    assert observations["player_1"]["action_mask"].tolist() == [1] * 9
    observations, *_ = env.step({"player_1": 4})
    assert observations["player_2"]["action_mask"].tolist() == [1] * 4 + [0] + [1] * 4
    with pytest.raises(IllegalAction, match="action 4 of player_2 is illegal"):
        env.step({"player_2": 4})


def test_infos_of_resets_and_steps_are_passed_on() -> None:
    env = LeagueEnv(league(f"{__name__}:with_infos"))
    results = episode_results(env, seed=7)
    assert results[0][1]["agent_0"] == {"seed": 7}
    assert results[1][4]["agent_1"] == {"time": 1}
    assert results[-1][4]["agent_0"] == {"time": 3}


def with_infos() -> Any:
    """A simultaneous environment with infos."""
    from tests.support.environments.simultaneous import Simultaneous

    class WithInfos(Simultaneous):
        def reset(self, seed: int | None = None, options: Any = None) -> Any:
            observations, infos = super().reset(seed, options)
            return observations, {agent: {"seed": seed} for agent in infos}

        def step(self, actions: dict[str, int]) -> Any:
            *answer, infos = super().step(actions)
            return *answer, {agent: {"time": self.time} for agent in infos}

    return WithInfos()


def test_later_resets_derive_their_seed_from_the_first() -> None:
    env, other, third = (LeagueEnv(league(f"{__name__}:with_infos")) for _ in range(3))

    def seeds(env: LeagueEnv, first: int | None) -> list[int]:
        return [env.reset(seed=seed)[1]["agent_0"]["seed"] for seed in (first, None, None, None)]

    drawn = seeds(env, 5)
    assert drawn[0] == 5
    assert len(set(drawn)) == 4
    assert seeds(other, 5) == drawn
    assert not set(seeds(third, None)) & set(drawn)


def test_the_environment_renders() -> None:
    env = LeagueEnv(league("mpe2.simple_spread_v3"), render_mode="rgb_array")
    env.reset(seed=0)
    image = env.render()
    assert image.dtype == np.uint8
    assert image.shape[2] == 3
    env.close()
    blind = LeagueEnv(league("mpe2.simple_spread_v3"))
    blind.reset(seed=0)
    with pytest.raises(EnvironmentMismatch, match="cannot be rendered"):
        blind.render()


def plain_script(name: str) -> PPOConfig:
    """A typical RLlib script."""
    return (
        PPOConfig()
        .environment(name)
        .env_runners(num_env_runners=0, num_envs_per_env_runner=2)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
        .training(train_batch_size_per_learner=120, minibatch_size=40, num_epochs=1)
    )


@pytest.mark.slow
@pytest.mark.usefixtures("ray_session")
def test_a_plain_rllib_script_trains_on_simple_spread() -> None:
    register(league("mpe2.simple_spread_v3", name="plain_spread"))
    algorithm = plain_script("plain_spread").build_algo()
    try:
        result = algorithm.train()
    finally:
        algorithm.stop()
    assert result[ENV_RUNNER_RESULTS][NUM_ENV_STEPS_SAMPLED] >= 120
    assert result[ENV_RUNNER_RESULTS][EPISODE_LEN_MEAN] == 25


@pytest.mark.usefixtures("ray_session")
def test_a_plain_rllib_script_trains_on_connect_four_with_a_masked_module() -> None:
    config = league("pettingzoo.classic.connect_four_v3", name="plain_four")
    register(config)
    env = LeagueEnv(config)
    module = RLModuleSpec(
        module_class=ActorCritic,
        observation_space=env.observation_spaces["player_0"],
        action_space=env.action_spaces["player_0"],
        model_config={"hidden": [16]},
    )
    spec = MultiRLModuleSpec(rl_module_specs={"shared": module})
    algorithm = plain_script("plain_four").rl_module(rl_module_spec=spec).build_algo()
    try:
        result = algorithm.train()
    finally:
        algorithm.stop()
    assert 7 <= result[ENV_RUNNER_RESULTS][EPISODE_LEN_MEAN] <= 42
