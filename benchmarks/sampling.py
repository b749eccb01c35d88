"""Self-play sampling of connect four in one runner: ours against RLlib's MultiAgentEnvRunner with its PettingZooEnv.

Both play the same network (a masked 2×256 multilayer perceptron) with exploration on one torch thread, both return
episodes that a Learner takes. Numbers of copies take turns within a round; a rate is the median over the rounds.
"""

import argparse
import logging
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import torch
from pettingzoo.classic import connect_four_v3
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.wrappers.pettingzoo_env import PettingZooEnv
from ray.tune.registry import register_env

from league.config import LeagueConfig
from league.environments.building import interface
from training.algorithms.ppo import algorithm_config
from training.modules.actor_critic import ActorCritic

COPIES = (1, 8, 16, 32, 64)
HIDDEN = (256, 256)
LEAGUE = LeagueConfig.from_mapping(
    {
        "league": "connect_four",
        "environment": {"entry_point": "pettingzoo.classic.connect_four_v3"},
        "training": {"runners": 0, "hidden": HIDDEN},
    }
)
TARGET_BEST, TARGET_DEFAULT = 2.0, 12.0


def main() -> int:
    """Print the rates and the two ratios; 1 if a ratio is below its target."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter measurements, for a look")
    quick = parser.parse_args().quick
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    runners = {("ours", copies): ours(copies) for copies in COPIES}
    runners |= {("RLlib", copies): rllib(copies) for copies in COPIES}
    rates = measure(runners, rounds=2 if quick else 5, seconds=0.5 if quick else 2.0)
    print(f"{'copies':>8} {'ours':>12} {'RLlib':>12}   moves/s in one runner")
    for copies in COPIES:
        print(f"{copies:>8} {rates['ours', copies]:>12,.0f} {rates['RLlib', copies]:>12,.0f}")
    best = {name: max(rates[name, copies] for copies in COPIES) for name in ("ours", "RLlib")}
    return verdict("RLlib's best", best["ours"] / best["RLlib"], TARGET_BEST) | verdict(
        "RLlib's default (1 copy)", best["ours"] / rates["RLlib", 1], TARGET_DEFAULT
    )


def verdict(peer: str, ratio: float, target: float) -> int:
    """Print a ratio against its target; 1 if it is below."""
    print(f"ours against {peer}: {ratio:.1f}x (target {target:g}x){'' if ratio >= target else '  BELOW TARGET'}")
    return int(ratio < target)


def measure(runners: dict[Any, EnvRunner], rounds: int, seconds: float) -> dict[Any, float]:
    """Moves per second of each runner."""
    samples: dict[Any, list[float]] = {key: [] for key in runners}
    for runner in runners.values():
        runner.sample(num_timesteps=500)
    for _ in range(rounds):
        for key, runner in runners.items():
            samples[key].append(rate(runner.sample, seconds))
    return {key: statistics.median(found) for key, found in samples.items()}


def rate(sample: Callable[..., list[Any]], seconds: float) -> float:
    """Moves per second over about `seconds`. Both count a move as one time step."""
    steps, began = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        sample(num_timesteps=1024)
        steps += 1024
    return steps / elapsed


def ours(copies: int) -> EnvRunner:
    """LockstepEnvRunner as training builds it."""
    config = algorithm_config(LEAGUE.with_training(copies=copies), interface(LEAGUE))
    return config.env_runner_cls(config=config, worker_index=0)


def rllib(copies: int) -> EnvRunner:
    """RLlib's runner as its documentation sets it up for a PettingZoo AEC environment."""
    register_env("connect_four", lambda _: PettingZooEnv(connect_four_v3.env()))
    env = connect_four_v3.env()
    agent = env.possible_agents[0]
    module = RLModuleSpec(
        module_class=ActorCritic,
        observation_space=env.observation_space(agent),
        action_space=env.action_space(agent),
        model_config={"hidden": list(HIDDEN)},
    )
    config = PPOConfig().environment("connect_four", disable_env_checking=True)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=copies)
    config.multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
    config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"shared": module}))
    return MultiAgentEnvRunner(config=config, worker_index=0)


if __name__ == "__main__":
    sys.exit(main())
