"""How fast does training sample, compared with RLlib's runner and with the unmodified environment? One torch thread per
runner.

Parts: simple_spread and connect_four (one runner compared with RLlib's MultiAgentEnvRunner with its PettingZoo
wrappers, for several numbers of environments), stock (one runner, including its network, compared with the unmodified
environment with random legal actions and without a network), iteration (PPO in one process: 4,000 environment steps, 4
epochs), runners (two compared with one). All use the same network, our 2×256 multilayer perceptron, also in RLlib.
Compared measurements alternate within a round; a rate is the median over the rounds. In one environment step, all
agents act once.
"""

import argparse
import logging
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import gymnasium
import numpy as np
import ray
import torch
from mpe2 import simple_spread_v3
from pettingzoo.classic import connect_four_v3, leduc_holdem_v4
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.columns import Columns
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.multi_agent_env_runner import MultiAgentEnvRunner
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv, PettingZooEnv
from ray.tune.registry import register_env

from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.ppo import PPO, algorithm_config
from training.modules.actor_critic import ActorCritic
from training.runs.trial import build_algorithm
from training.sampling.env_runner import BatchedEnvRunner

NUM_ENVS = (1, 4, 8, 16, 32, 64)
MANY_ENVS = (256, 1024)
"""Only for our runner."""
HIDDEN = (256, 256)
SPREAD, FOUR, LEDUC = (
    "mpe2.simple_spread_v3",
    "pettingzoo.classic.connect_four_v3",
    "pettingzoo.classic.leduc_holdem_v4",
)
AGENTS = {SPREAD: 3, FOUR: 1, LEDUC: 1}
"""Agents that act in one step."""
STEPS, EPOCHS, MINIBATCH = 4000, 4, 128
"""Of an iteration; the minibatch size is RLlib's default."""
LARGE_MINIBATCH = 960
"""As in the bundled simple_spread, whose learning target `benchmarks.learning` measures with these settings too."""

Rates = dict[Hashable, float]


class Flat(ActorCritic):
    """The same network on observations that are not a dictionary, as returned by RLlib's wrappers."""

    def setup(self) -> None:
        self.observation_space = gymnasium.spaces.Dict({"observation": self.observation_space})
        super().setup()

    def _forward(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        return super()._forward({Columns.OBS: {"observation": batch[Columns.OBS]}})

    def _forward_train(self, batch: dict[str, Any], **_: Any) -> dict[str, Any]:
        return super()._forward_train({Columns.OBS: {"observation": batch[Columns.OBS]}})

    def compute_values(self, batch: dict[str, Any], embeddings: Any = None) -> Any:
        return super().compute_values({Columns.OBS: {"observation": batch[Columns.OBS]}}, embeddings)


def simple_spread(quick: bool) -> bool:
    """At least 50 times RLlib's best, and 6 times its default."""
    return against_rllib(SPREAD, quick, best=50.0, default=6.0)


def connect_four(quick: bool) -> bool:
    """At least 60 times RLlib's best, and 12 times its default."""
    return against_rllib(FOUR, quick, best=60.0, default=12.0)


def against_rllib(entry_point: str, quick: bool, best: float, default: float) -> bool:
    """One runner compared with RLlib's, for several numbers of environments."""
    sizes = (*NUM_ENVS, *MANY_ENVS)
    runners: dict[Hashable, EnvRunner] = {("ours", num_envs): ours(entry_point, num_envs) for num_envs in sizes}
    runners |= {("RLlib", num_envs): rllib(entry_point, num_envs) for num_envs in NUM_ENVS}
    for runner in runners.values():
        runner.sample(num_timesteps=500)
    seconds = 0.5 if quick else 2.0
    rates: dict[tuple[str, int], float] = in_rounds(
        {key: lambda runner=runner: sampling_rate(runner, entry_point, seconds) for key, runner in runners.items()},
        rounds=2 if quick else 5,
    )
    print(f"{'num_envs':>8} {'ours':>12} {'RLlib':>12}   environment steps/s in one runner")
    for num_envs in sizes:
        theirs = f"{rates['RLlib', num_envs]:>12,.0f}" if num_envs in NUM_ENVS else ""
        print(f"{num_envs:>8} {rates['ours', num_envs]:>12,.0f} {theirs}")
    top = {name: max(rate for (whose, _), rate in rates.items() if whose == name) for name in ("ours", "RLlib")}
    met = [
        report("ours against RLlib's best", top["ours"] / top["RLlib"], best),
        report("ours against RLlib's default (1 environment)", top["ours"] / rates["RLlib", 1], default),
    ]
    for runner in runners.values():
        runner.stop()
    return all(met)


def stock(quick: bool) -> bool:
    """At least 75 % of the rate of the unmodified environment alone."""
    modules = {SPREAD: simple_spread_v3, FOUR: connect_four_v3, LEDUC: leduc_holdem_v4}
    met = [against_stock(name, module, quick) for name, module in modules.items()]
    return all(met)


def against_stock(entry_point: str, module: Any, quick: bool) -> bool:
    """One runner with 32 environments."""
    runner, seconds = ours(entry_point, num_envs=32), 0.5 if quick else 2.0
    runner.sample(num_timesteps=3000)
    alone = in_parallel if entry_point == SPREAD else in_turns
    rates = in_rounds(
        {"ours": lambda: sampling_rate(runner, entry_point, seconds), "stock": lambda: alone(module, seconds)},
        rounds=3 if quick else 7,
    )
    runner.stop()
    name = entry_point.rpartition(".")[2]
    print(f"{name}: ours {rates['ours']:,.0f}, the stock environment alone {rates['stock']:,.0f} steps/s")
    return report(f"{name}, ours against the stock environment", rates["ours"] / rates["stock"], 0.75)


def iteration(quick: bool) -> bool:
    """At least 14 times RLlib's default, 25 times with large minibatches; RLlib's best is printed as well."""
    default, best = "RLlib's default", "RLlib's best (32 environments)"
    large = f"ours, minibatches of {LARGE_MINIBATCH}"
    algorithms = {
        "ours": our_ppo(num_envs=32, minibatch_size=MINIBATCH),
        large: our_ppo(num_envs="auto", minibatch_size=LARGE_MINIBATCH),
        default: rllib_ppo(1),
        best: rllib_ppo(32),
    }
    for algorithm in algorithms.values():
        algorithm.train()
    rates = in_rounds(
        {key: lambda algorithm=algorithm: iteration_rate(algorithm) for key, algorithm in algorithms.items()},
        rounds=1 if quick else 3,
    )
    for name, rate in rates.items():
        print(f"{name}: {STEPS / rate:.2f} s per iteration of {STEPS:,} environment steps, {EPOCHS} epochs")
    for algorithm in algorithms.values():
        algorithm.stop()
    print(f"an iteration, ours against RLlib's best: {rates['ours'] / rates[best]:.1f}x")
    same = report("an iteration, ours against RLlib's default", rates["ours"] / rates[default], 14.0)
    return report(f"an iteration, {large}, against RLlib's default", rates[large] / rates[default], 25.0) and same


def runners(quick: bool) -> bool:
    """Two runners sample at least 1.7 times as fast as one."""
    batch = 9600
    algorithms = {
        count: build_algorithm(league(SPREAD, runners=count, train_batch_size=batch), interface(league(SPREAD)))
        for count in (1, 2)
    }
    rates = in_rounds(
        {count: lambda algorithm=algorithm: gathering_rate(algorithm) for count, algorithm in algorithms.items()},
        rounds=5 if quick else 15,
    )
    for algorithm in algorithms.values():
        algorithm.stop()
    print(f"one runner {rates[1]:,.0f}, two {rates[2]:,.0f} actions/s, in batches of {batch:,}")
    return report("two runners against one", rates[2] / rates[1], 1.7)


def league(entry_point: str, **training: Any) -> LeagueConfig:
    """A league of that environment with one policy."""
    settings = {"runners": 0, "num_envs": 32, "hidden": HIDDEN} | training
    document = {"league": "benchmark", "environment": {"entry_point": entry_point}, "training": settings}
    return LeagueConfig.from_mapping(document)


def ours(entry_point: str, num_envs: int) -> EnvRunner:
    """BatchedEnvRunner as created by training."""
    config = league(entry_point, num_envs=num_envs)
    return BatchedEnvRunner(algorithm_config(config, interface(config)), worker_index=0)


def rllib(entry_point: str, num_envs: int) -> EnvRunner:
    """RLlib's runner as configured in its documentation for a PettingZoo environment."""
    return MultiAgentEnvRunner(config=rllib_config(entry_point, num_envs), worker_index=0)


def rllib_config(entry_point: str, num_envs: int) -> PPOConfig:
    """RLlib's PPO with its default settings, except for the number of environments and the network."""
    if entry_point == SPREAD:
        wrapped: Any = ParallelPettingZooEnv(simple_spread_v3.parallel_env())
        register_env(entry_point, lambda _: ParallelPettingZooEnv(simple_spread_v3.parallel_env()))
    else:
        wrapped = PettingZooEnv(connect_four_v3.env())
        register_env(entry_point, lambda _: PettingZooEnv(connect_four_v3.env()))
    agent = wrapped.possible_agents[0]
    observation = wrapped.observation_space[agent]
    module = RLModuleSpec(
        module_class=ActorCritic if isinstance(observation, gymnasium.spaces.Dict) else Flat,
        observation_space=observation,
        action_space=wrapped.action_space[agent],
        model_config={"hidden": list(HIDDEN)},
    )
    config = PPOConfig().environment(entry_point, disable_env_checking=True)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=num_envs)
    config.multi_agent(policies={"shared"}, policy_mapping_fn=lambda *_, **__: "shared")
    return config.rl_module(rl_module_spec=MultiRLModuleSpec(rl_module_specs={"shared": module}))


def our_ppo(**training: Any) -> Algorithm:
    """PPO that learns from the actions of all agents in each environment step; RLlib counts steps, we count actions."""
    config = league(SPREAD, train_batch_size=STEPS * AGENTS[SPREAD], epochs=EPOCHS, runners=0, **training)
    return build_algorithm(config, interface(config))


def rllib_ppo(num_envs: int) -> Algorithm:
    """RLlib's PPO."""
    config = rllib_config(SPREAD, num_envs)
    config.training(train_batch_size_per_learner=STEPS, num_epochs=EPOCHS, minibatch_size=MINIBATCH)
    return config.build_algo()


def in_rounds(measures: Mapping[Any, Callable[[], float]], rounds: int) -> Any:
    """The median of each measurement over the rounds, in alternation."""
    found: dict[Any, list[float]] = {key: [] for key in measures}
    for _ in range(rounds):
        for key, measure in measures.items():
            found[key].append(measure())
    return {key: statistics.median(values) for key, values in found.items()}


def sampling_rate(runner: EnvRunner, entry_point: str, seconds: float) -> float:
    """Environment steps per second, including episodes for a learner. RLlib counts steps, our runner counts actions."""
    is_ours = isinstance(runner, BatchedEnvRunner)
    sample, share = (runner.sample_chunks, AGENTS[entry_point]) if is_ours else (runner.sample, 1)
    size = max(1024, 16 * runner.config.num_envs_per_env_runner)
    steps, began = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        sample(num_timesteps=size * share)
        steps += size
    return steps / elapsed


def in_parallel(module: Any, seconds: float) -> float:
    """Steps per second of the unmodified `parallel_env()`, with random actions."""
    env, rng, steps = module.parallel_env(), np.random.default_rng(0), 0
    spaces = {agent: int(env.action_space(agent).n) for agent in env.possible_agents}
    began = time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        env.reset()
        while env.agents:
            env.step({agent: int(rng.integers(spaces[agent])) for agent in env.agents})
            steps += 1
    return steps / elapsed


def in_turns(module: Any, seconds: float) -> float:
    """Moves per second of the unmodified `env()`, with random legal actions, in PettingZoo's loop."""
    env, rng, moves = module.env(), np.random.default_rng(0), 0
    began = time.perf_counter()
    while (elapsed := time.perf_counter() - began) < seconds:
        env.reset()
        for _ in env.agent_iter():
            observation, _, terminated, truncated, _ = env.last()
            if terminated or truncated:
                env.step(None)
            else:
                env.step(int(rng.choice(np.flatnonzero(observation["action_mask"]))))
                moves += 1
    return moves / elapsed


def iteration_rate(algorithm: Algorithm) -> float:
    """Environment steps per second of one iteration, including learning."""
    began = time.perf_counter()
    algorithm.train()
    return STEPS / (time.perf_counter() - began)


def gathering_rate(algorithm: PPO) -> float:
    """Actions per second until a batch has arrived from all runners."""
    began = time.perf_counter()
    chunks, _ = algorithm.sample_train_batch()
    return sum(int(own.lengths.sum()) for own in chunks) / (time.perf_counter() - began)


def report(what: str, ratio: float, target: float) -> bool:
    """Print a ratio with its target; returns whether it is met."""
    print(f"{what}: {ratio:.2f}x (target {target:g}x){'' if ratio >= target else '  BELOW TARGET'}", flush=True)
    return ratio >= target


PARTS: dict[str, Callable[[bool], bool]] = {
    part.__name__: part for part in (simple_spread, connect_four, stock, iteration, runners)
}


def main() -> int:
    """Run the requested parts; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"some of {', '.join(PARTS)}; default: all")
    parser.add_argument("--quick", action="store_true", help="shorter measurements")
    options = parser.parse_args()
    if unknown := [part for part in options.parts if part not in PARTS]:
        parser.error(f"no part {', '.join(unknown)}: expected some of {', '.join(PARTS)}")
    logging.disable(logging.WARNING)
    warnings.simplefilter("ignore")
    ray.init(address="local", num_cpus=4, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    torch.set_num_threads(1)
    missed = []
    for name in options.parts or PARTS:
        print(f"\n-- {name} --", flush=True)
        if not PARTS[name](options.quick):
            missed.append(name)
    print(f"\nmissed: {', '.join(missed)}" if missed else "\nall met")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
