"""From RLlib's result of an update to the curves of a run: return, length, loss, entropy, KL … per policy and agent.

| curve | |
|---|---|
| `return`, `length` | of the episodes that ended, all agents together |
| `episodes`, `crashes` | how many ended, and how many were lost because the environment raised |
| `<policy>/return`, `<policy>/length` | mean over the agents of a policy |
| `<policy>/entropy` | of the distributions that were played from, in nats |
| `<policy>/policy_loss`, `value_loss`, `kl`, `clip_fraction`, `explained_variance`, `gradient_norm` | of its learning |
| `<policy>/loss`, `value`, `error` | off-policy: loss, values of actions, TD errors; centralised ones under `joint` |
| `<policy>/policy_loss`, `critic_gradient_norm` | of actors with critics; loss, value and error are the critic's |
| `exploration` | off-policy: how much is explored |
| `agents/<agent>/return`, `agents/<agent>/length` | of one agent |
| `time/sampling`, `time/learning`, `time/weights`, `time/checkpoint` | seconds of wall time in the report |
| `gpu/memory_gb`, `gpu/utilization` | where there is one: most that the learner held, percent of time busy |
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import torch
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.utils.metrics import (
    ENV_RUNNER_RESULTS,
    ENV_RUNNER_SAMPLING_TIMER,
    EPISODE_AGENT_RETURN_MEAN,
    EPISODE_LEN_MEAN,
    EPISODE_MODULE_RETURN_MEAN,
    EPISODE_RETURN_MEAN,
    LEARNER_RESULTS,
    LEARNER_UPDATE_TIMER,
    NUM_EPISODES,
    SYNCH_WORKER_WEIGHTS_TIMER,
    TIMERS,
)

from league.interface import Interface
from training.sampling.closed import JOINT
from training.sampling.play_metrics import CRASHES, ENTROPY, EPISODE_AGENT_LEN_MEAN, EPISODE_MODULE_LEN_MEAN

RETURN = "return"
PHASES = {
    "time/sampling": ENV_RUNNER_SAMPLING_TIMER,
    "time/learning": LEARNER_UPDATE_TIMER,
    "time/weights": SYNCH_WORKER_WEIGHTS_TIMER,
}
CHECKPOINT_TIME = "time/checkpoint"
LEARNED = {
    "policy_loss": "policy_loss",
    "value_loss": "vf_loss",
    "kl": "kl",
    "clip_fraction": "clip_fraction",
    "explained_variance": "vf_explained_var",
    "gradient_norm": "gradient_norm",
}

OFF_POLICY = ("loss", "value", "error", "gradient_norm")
ACTORS = ("policy_loss", "critic_gradient_norm")
"""Of actors with critics: `loss`, `value` and `error` are then the critic's, `gradient_norm` the actor's."""
LEARNED_BY = {"ppo": tuple(LEARNED), "maddpg": (*OFF_POLICY, *ACTORS)}
EXPLORATION = "exploration"
"""Logged by off-policy algorithms at the top of RLlib's result."""


def time_each_update(algorithm: Algorithm) -> None:
    """Have the algorithm report the phases of its newest update: RLlib's own timers average over hundreds."""
    for timer in PHASES.values():
        algorithm.metrics.log_time((TIMERS, timer), reduce="mean", window=1)


def names(interface: Interface, algorithm: str = "ppo") -> set[str]:
    """The curves that training has of what was learned."""
    of_policy = {RETURN, "length", "entropy", *LEARNED_BY.get(algorithm, OFF_POLICY)}
    return (
        {RETURN, "length"}
        | {f"{policy}/{name}" for policy in interface.policy_ids for name in of_policy}
        | {f"agents/{agent}/{name}" for agent in interface.agents for name in (RETURN, "length")}
    )


def curves(result: Mapping[str, Any], interface: Interface) -> dict[str, float]:
    """The curves of one update; what did not occur in it, such as the end of an episode, is left out."""
    play = result[ENV_RUNNER_RESULTS]
    found: dict[str, Any] = {
        RETURN: play.get(EPISODE_RETURN_MEAN),
        "length": play.get(EPISODE_LEN_MEAN),
        EXPLORATION: result.get(EXPLORATION),
    }
    for policy in interface.policy_ids:
        found[f"{policy}/return"] = play.get(EPISODE_MODULE_RETURN_MEAN, {}).get(policy)
        found[f"{policy}/length"] = play.get(EPISODE_MODULE_LEN_MEAN, {}).get(policy)
        found[f"{policy}/entropy"] = play.get(policy, {}).get(ENTROPY)
    for agent in interface.agents:
        found[f"agents/{agent}/return"] = play.get(EPISODE_AGENT_RETURN_MEAN, {}).get(agent)
        found[f"agents/{agent}/length"] = play.get(EPISODE_AGENT_LEN_MEAN, {}).get(agent)
    # What was once logged stays in RLlib's answer, as NaN: no episode ended in this update.
    found = {name: value for name, value in found.items() if value is not None and not math.isnan(value)}
    for key in (*interface.policy_ids, JOINT):
        learned = result.get(LEARNER_RESULTS, {}).get(key, {})
        found |= {f"{key}/{name}": learned.get(metric) for name, metric in LEARNED.items()}
        found |= {f"{key}/{name}": learned.get(name) for name in (*OFF_POLICY, *ACTORS)}
    return {name: float(value) for name, value in found.items() if value is not None}


def amounts(result: Mapping[str, Any]) -> dict[str, float]:
    """What adds up from one update to the next: episodes, crashes, and the seconds of each phase."""
    play = result[ENV_RUNNER_RESULTS]
    counts = {"episodes": float(play.get(NUM_EPISODES, 0)), "crashes": float(play.get(CRASHES, 0))}
    return counts | {name: float(result[TIMERS].get(timer, 0.0)) for name, timer in PHASES.items()}


def gpu_use() -> dict[str, float]:
    """Of this process's GPU since the last call; nothing without one. How busy it is, only where NVML tells."""
    if not torch.cuda.is_available():
        return {}
    use = {"gpu/memory_gb": torch.cuda.max_memory_allocated() / 1e9}
    torch.cuda.reset_peak_memory_stats()
    with suppress(ModuleNotFoundError, RuntimeError):  # torch needs nvidia-ml-py for it
        use["gpu/utilization"] = float(torch.cuda.utilization())
    return use
