"""Extracts a run's metrics from RLlib's results: return, length, loss, entropy, KL per policy and agent.

docs/curves.md explains the curves. In addition: `episodes` and `crashes`, the episodes that ended and that were lost
because the environment raised; `agents/<agent>/return` and `length` of one agent; `time/<phase>`, wall time since the
last report in seconds, with `time/other` for the rest, and `time/runners_…`, the time of all runners together; with a
GPU, `gpu/memory_gb`, the learner's peak memory, and `gpu/utilization`. A centralised off-policy learner reports under
`joint`.
"""

import math
from collections.abc import Iterable, Mapping
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
from training.algorithms.league_algorithm import SHARE, WAITING_TIMER
from training.learners.ppo import MAGNET_KL, MAGNET_WEIGHT, SCHEDULES, TEACHER_LOSS, TEACHER_WEIGHT
from training.sampling.closed_transitions import JOINT
from training.sampling.env_runner import IDLE_SECONDS, SAMPLING_SECONDS
from training.sampling.play_metrics import CRASHES, ENTROPY, EPISODE_AGENT_LEN_MEAN, EPISODE_MODULE_LEN_MEAN
from training.sampling.self_play import OPPONENTS, SCORE

RETURN = "return"
PHASES = {
    "time/sampling": ENV_RUNNER_SAMPLING_TIMER,
    "time/waiting": WAITING_TIMER,
    "time/learning": LEARNER_UPDATE_TIMER,
    "time/weights": SYNCH_WORKER_WEIGHTS_TIMER,
}
"""Of the process of the learner, whose wall time they divide, together with OTHER_TIME. With runners, it waits for
samples instead of sampling."""
RUNNER_TIMES = {"time/runners_sampling": SAMPLING_SECONDS, "time/runners_idle": IDLE_SECONDS}
"""Of all remote runners together."""
CHECKPOINT_TIME = "time/checkpoint"
OTHER_TIME = "time/other"
"""Wall time of updates outside of the phases: RLlib's bookkeeping and metrics."""
PPO_METRICS = {
    "policy_loss": "policy_loss",
    "value_loss": "vf_loss",
    "kl": "kl",
    "clip_fraction": "clip_fraction",
    "explained_variance": "vf_explained_var",
    "gradient_norm": "gradient_norm",
}
REFERENCE_METRICS = (MAGNET_KL, MAGNET_WEIGHT, TEACHER_LOSS, TEACHER_WEIGHT)
"""Reported only with a magnet or a teacher."""
OFF_POLICY_METRICS = {name: name for name in ("loss", "value", "error", "gradient_norm")}
ACTOR_METRICS = {name: name for name in ("policy_loss", "critic_gradient_norm")}
"""With critics, `loss`, `value` and `error` are the critic's and `gradient_norm` is the actor's."""
EXPLORATION = "exploration"
"""Off-policy algorithms log it at the top level of RLlib's result."""


def time_each_update(algorithm: Algorithm) -> None:
    """Report the duration of each update's phases: RLlib's own timers average over hundreds of updates."""
    for timer in PHASES.values():
        algorithm.metrics.log_time((TIMERS, timer), reduce="mean", window=1)


def metric_names(interface: Interface, curves: Iterable[str] = PPO_METRICS) -> set[str]:
    """Return the names of the metrics that an algorithm with these curves reports for a league."""
    of_policy = {RETURN, "length", "entropy", *curves}
    return (
        {RETURN, "length"}
        | {f"{policy}/{name}" for policy in interface.policy_ids for name in of_policy}
        | {f"agents/{agent}/{name}" for agent in interface.agents for name in (RETURN, "length")}
    )


def training_metrics(
    result: Mapping[str, Any], interface: Interface, curves: Mapping[str, str] = PPO_METRICS
) -> dict[str, float]:
    """Return the metrics of one update, without those that did not occur in it, such as the return of ended episodes.

    curves: of the algorithm.
    """
    play = result[ENV_RUNNER_RESULTS]
    metrics: dict[str, Any] = {
        RETURN: play.get(EPISODE_RETURN_MEAN),
        "length": play.get(EPISODE_LEN_MEAN),
        EXPLORATION: result.get(EXPLORATION),
    }
    for policy in interface.policy_ids:
        metrics[f"{policy}/return"] = play.get(EPISODE_MODULE_RETURN_MEAN, {}).get(policy)
        metrics[f"{policy}/length"] = play.get(EPISODE_MODULE_LEN_MEAN, {}).get(policy)
        metrics[f"{policy}/entropy"] = play.get(policy, {}).get(ENTROPY)
    for agent in interface.agents:
        metrics[f"agents/{agent}/return"] = play.get(EPISODE_AGENT_RETURN_MEAN, {}).get(agent)
        metrics[f"agents/{agent}/length"] = play.get(EPISODE_AGENT_LEN_MEAN, {}).get(agent)
    for ref, values in result.get(OPPONENTS, {}).items():
        metrics |= {f"{OPPONENTS}/{ref}/{name}": values.get(name) for name in (SCORE, SHARE)}
    # RLlib reports NaN for what was logged earlier but not in this update.
    metrics = {name: value for name, value in metrics.items() if value is not None and not math.isnan(value)}
    for key in (*interface.policy_ids, JOINT):
        learned = result.get(LEARNER_RESULTS, {}).get(key, {})
        metrics |= {f"{key}/{name}": learned.get(metric) for name, metric in curves.items()}
        metrics |= {f"{key}/{name}": learned.get(name) for name in (*SCHEDULES.values(), *REFERENCE_METRICS)}
    return {name: float(value) for name, value in metrics.items() if value is not None}


def totals(result: Mapping[str, Any]) -> dict[str, float]:
    """Return the metrics that add up over updates: episodes, crashes, and the seconds of each phase that occurred."""
    play, timers = result[ENV_RUNNER_RESULTS], result[TIMERS]
    counts = {"episodes": float(play.get(NUM_EPISODES, 0)), "crashes": float(play.get(CRASHES, 0))}
    times = {
        name: float(timers[timer]) for name, timer in PHASES.items() if not math.isnan(timers.get(timer, math.nan))
    }
    if "time/waiting" in times:
        times |= {name: float(play[key]) for name, key in RUNNER_TIMES.items()}
    return counts | times


def gpu_use() -> dict[str, float]:
    """Return peak memory and utilisation of this process's GPU since the last call; empty without a GPU.

    Utilisation is left out if nvidia-ml-py is not installed.
    """
    if not torch.cuda.is_available():
        return {}
    use = {"gpu/memory_gb": torch.cuda.max_memory_allocated() / 1e9}
    torch.cuda.reset_peak_memory_stats()
    with suppress(ModuleNotFoundError, RuntimeError):  # needs nvidia-ml-py
        use["gpu/utilization"] = float(torch.cuda.utilization())
    return use
