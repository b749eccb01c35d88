"""How fast does training sample, compared with RLlib's runner and with the unmodified environment?

One torch thread per runner.

Parts: simple_spread and connect_four (one runner compared with RLlib's MultiAgentEnvRunner with its PettingZoo
wrappers, for several numbers of environments), stock (one runner, including its network, compared with the unmodified
environment with random legal actions and without a network), iteration (PPO in one process: 4,000 environment steps, 4
epochs), runners (two compared with one). All use the same network, our 2×256 multilayer perceptron, also in RLlib.
Compared measurements alternate within a round; a rate is the median over the rounds. In one environment step, all
agents act once.
"""

import time
import timeit
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
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

from benchmarks.harness import Parts, Quick, Target, chosen, in_rounds, rate
from benchmarks.stock import play_game
from benchmarks.training.learned import local_ray
from league.config.league import LeagueConfig
from league.environments.building import interface
from training.algorithms.ppo import PPO
from training.algorithms.rllib_config import algorithm_config
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


def simple_spread(quick: bool) -> Iterator[Target]:
    yield from against_rllib(SPREAD, quick, best=50.0, default=6.0)


def connect_four(quick: bool) -> Iterator[Target]:
    yield from against_rllib(FOUR, quick, best=60.0, default=12.0)


def against_rllib(entry_point: str, quick: bool, best: float, default: float) -> Iterator[Target]:
    """One runner compared with RLlib's, for several numbers of environments."""
    sizes = {"ours": (*NUM_ENVS, *MANY_ENVS), "RLlib": NUM_ENVS}
    runners: dict[tuple[str, int], EnvRunner] = {("ours", size): ours(entry_point, size) for size in sizes["ours"]}
    runners |= {("RLlib", size): rllib(entry_point, size) for size in sizes["RLlib"]}
    for runner in runners.values():
        runner.sample(num_timesteps=500)
    seconds = 0.5 if quick else 2.0
    rates = in_rounds(
        {key: partial(sampling_rate, runner, entry_point, seconds) for key, runner in runners.items()},
        rounds=2 if quick else 5,
    )
    for runner in runners.values():
        runner.stop()
    name = short(entry_point)
    tops = {}
    for program, counts in sizes.items():
        values = [rates[program, count] for count in counts]
        tops[program] = max(values)
        note = f"with {', '.join(map(str, counts))} environments"
        yield Target(f"{name} by {program}", tuple(map(round, values)), "steps/s", note=note)
    yield Target(name, tops["ours"] / tops["RLlib"], "×", at_least=best, peer="RLlib's best")
    yield Target(name, tops["ours"] / rates["RLlib", 1], "×", at_least=default, peer="RLlib's default")


def stock(quick: bool) -> Iterator[Target]:
    """At least 75 % of the rate of the unmodified environment alone; one runner with 32 environments."""
    for entry_point, module in {SPREAD: simple_spread_v3, FOUR: connect_four_v3, LEDUC: leduc_holdem_v4}.items():
        runner, seconds = ours(entry_point, num_envs=32), 0.5 if quick else 2.0
        runner.sample(num_timesteps=3000)
        alone = in_parallel if entry_point == SPREAD else in_turns
        rates = in_rounds(
            {"ours": partial(sampling_rate, runner, entry_point, seconds), "stock": partial(alone, module, seconds)},
            rounds=3 if quick else 7,
        )
        runner.stop()
        note = f"{rates['ours']:,.0f} to {rates['stock']:,.0f} steps/s"
        ratio = rates["ours"] / rates["stock"]
        yield Target(short(entry_point), ratio, "×", at_least=0.75, peer="the stock environment", note=note)


def iteration(quick: bool) -> Iterator[Target]:
    """At least 14 times RLlib's default, 25 times with large minibatches."""
    large = f"iteration, minibatches of {LARGE_MINIBATCH}"
    algorithms = {
        "iteration": our_ppo(num_envs=32, minibatch_size=MINIBATCH),
        large: our_ppo(num_envs="auto", minibatch_size=LARGE_MINIBATCH),
        "RLlib's default": rllib_ppo(1),
        "RLlib's best": rllib_ppo(32),
    }
    for algorithm in algorithms.values():
        algorithm.train()
    seconds = in_rounds(
        {key: partial(timeit.timeit, algorithm.train, number=1) for key, algorithm in algorithms.items()},
        rounds=1 if quick else 3,
    )
    for algorithm in algorithms.values():
        algorithm.stop()
    for name, peer, least in (
        ("iteration", "RLlib's default", 14.0),
        ("iteration", "RLlib's best", None),
        (large, "RLlib's default", 25.0),
    ):
        note = f"{seconds[name]:.2f} to {seconds[peer]:.2f} s"
        yield Target(name, seconds[peer] / seconds[name], "×", at_least=least, peer=peer, note=note)


def runners(quick: bool) -> Iterator[Target]:
    """Two runners sample at least 1.7 times as fast as one."""
    algorithms = {
        count: build_algorithm(league(SPREAD, runners=count, train_batch_size=9600, lag=0), interface(league(SPREAD)))
        for count in (1, 2)
    }
    rates = in_rounds(
        {count: partial(gathering_rate, algorithm) for count, algorithm in algorithms.items()},
        rounds=5 if quick else 15,
    )
    for algorithm in algorithms.values():
        algorithm.stop()
    yield Target("two runners", rates[2] / rates[1], "×", at_least=1.7, peer="one")


def short(entry_point: str) -> str:
    """The name of an environment without its package and version."""
    return entry_point.rpartition(".")[2].rpartition("_")[0]


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


def sampling_rate(runner: EnvRunner, entry_point: str, seconds: float) -> float:
    """Environment steps per second, including episodes for a learner. RLlib counts steps, our runner counts actions."""
    is_ours = isinstance(runner, BatchedEnvRunner)
    sample, share = (runner.sample_chunks, AGENTS[entry_point]) if is_ours else (runner.sample, 1)
    size = max(1024, 16 * runner.config.num_envs_per_env_runner)

    def step() -> float:
        sample(num_timesteps=size * share)
        return size

    return rate(step, seconds)


def in_parallel(module: Any, seconds: float) -> float:
    """Steps per second of the unmodified `parallel_env()`, with random actions."""
    env, rng = module.parallel_env(), np.random.default_rng(0)
    sizes = {agent: int(env.action_space(agent).n) for agent in env.possible_agents}

    def episode() -> int:
        env.reset()
        steps = 0
        while env.agents:
            env.step({agent: int(rng.integers(sizes[agent])) for agent in env.agents})
            steps += 1
        return steps

    return rate(episode, seconds)


def in_turns(module: Any, seconds: float) -> float:
    """Moves per second of the unmodified `env()`, with random legal actions, in PettingZoo's loop."""
    env, rng = module.env(), np.random.default_rng(0)
    return rate(lambda: play_game(env, lambda _, mask: int(rng.choice(np.flatnonzero(mask)))), seconds)


def gathering_rate(algorithm: PPO) -> float:
    """Actions per second until a batch has arrived from all runners."""
    began = time.perf_counter()
    chunks, _ = algorithm.sample_train_batch()
    return sum(int(chunk.lengths.sum()) for chunk in chunks) / (time.perf_counter() - began)


PARTS: dict[str, Callable[[bool], Iterator[Target]]] = {
    part.__name__: part for part in (simple_spread, connect_four, stock, iteration, runners)
}


def main(parts: Parts = None, quick: Quick = False) -> Iterator[Target]:
    """Measure the parts."""
    torch.set_num_threads(1)
    with local_ray(cpus=4):
        for part in chosen(parts, PARTS).values():
            yield from part(quick)
