"""How fast are transitions of three agents stored and sampled, compared with RLlib's multi-agent replay buffer?

Both contain the same 100,000 steps of simple_spread, three agents with 18 numbers each, and sample 1,024 steps of all
three agents: ours from rows of a ring buffer, RLlib's MultiAgentEpisodeReplayBuffer from episodes, in the mode that
keeps agents together (`synchronized`) and in its default mode, which draws agents' steps independently. Median of the
calls in a round; compared measurements alternate; one thread.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.utils.replay_buffers.multi_agent_episode_buffer import MultiAgentEpisodeReplayBuffer

from league.config.off_policy import PrioritiesConfig
from training.replay_buffer import ReplayBuffer, TransitionBlock

STEPS, BATCH, LENGTH, NUMBERS = 100_000, 1024, 25, 18
AGENTS = ("agent_0", "agent_1", "agent_2")
MAX_SECONDS, FASTER = 1e-3, 50.0


def our_buffer(priorities: PrioritiesConfig | None) -> ReplayBuffer:
    """A full buffer of joint transitions with their global state."""
    rng = np.random.default_rng(0)
    n, shape = STEPS, (STEPS, len(AGENTS), NUMBERS)
    ends = np.arange(n) % LENGTH == LENGTH - 1
    rows = {
        "present/shared": np.ones((n, 3), dtype=bool),
        "observations/shared/observation": rng.standard_normal(shape, dtype=np.float32),
        "actions/shared": rng.integers(5, size=(n, 3)),
        "rewards/shared": rng.standard_normal((n, 3), dtype=np.float32),
        "terminated/shared": np.zeros((n, 3), dtype=bool),
        "truncated/shared": np.repeat(ends[:, np.newaxis], 3, axis=1),
        "next_observations/shared/observation": rng.standard_normal(shape, dtype=np.float32),
        "state": rng.standard_normal((n, 3 * NUMBERS), dtype=np.float32),
        "next_state": rng.standard_normal((n, 3 * NUMBERS), dtype=np.float32),
    }
    replay = ReplayBuffer(STEPS, priorities=priorities)
    replay.add(TransitionBlock(rows, np.zeros(n, dtype=np.int64), np.roll(ends, 1)))
    return replay


def rllib_buffer(steps: int) -> MultiAgentEpisodeReplayBuffer:
    """The same transitions as episodes."""
    rng = np.random.default_rng(0)
    buffer = MultiAgentEpisodeReplayBuffer(capacity=steps)
    for number in range(steps // LENGTH):
        observations = [
            {agent: rng.standard_normal(NUMBERS, dtype=np.float32) for agent in AGENTS} for _ in range(LENGTH + 1)
        ]
        episode = MultiAgentEpisode(
            id_=str(number),
            observations=observations,
            actions=[{agent: int(rng.integers(5)) for agent in AGENTS} for _ in range(LENGTH)],
            rewards=[{agent: float(rng.standard_normal()) for agent in AGENTS} for _ in range(LENGTH)],
            truncateds=dict.fromkeys((*AGENTS, "__all__"), True),
            len_lookback_buffer=0,
            agent_module_ids=dict.fromkeys(AGENTS, "shared"),
        )
        buffer.add(episode.to_numpy())
    return buffer


def seconds(call: Callable[[], object], calls: int) -> float:
    """The median duration of some calls."""
    taken = []
    for _ in range(calls):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def main() -> int:
    """Print the durations; 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer steps in RLlib's buffer and fewer calls")
    quick = parser.parse_args().quick
    uniform, prioritised = our_buffer(None), our_buffer(PrioritiesConfig())
    buffer = rllib_buffer(STEPS // 10 if quick else STEPS)
    contestants: dict[str, Callable[[], object]] = {
        "ours, uniform": lambda: uniform.sample(BATCH),
        "ours, uniform, 3 steps": lambda: uniform.sample(BATCH, n_step=3, gamma=0.99),
        "ours, prioritised": lambda: prioritised.sample(BATCH),
        "ours, prioritised, 3 steps": lambda: prioritised.sample(BATCH, n_step=3, gamma=0.99),
        "RLlib, synchronized": lambda: buffer.sample(BATCH, replay_mode="synchronized"),
        "RLlib, independent": lambda: buffer.sample(BATCH * len(AGENTS), replay_mode="independent"),
    }
    rounds = 2 if quick else 5
    taken: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, call in contestants.items():
            taken[name].append(seconds(call, 5 if name.startswith("RLlib") else 100))
    medians = {name: statistics.median(values) for name, values in taken.items()}
    for name, value in medians.items():
        print(f"{name:>28}: {1e3 * value:8.3f} ms for {BATCH} steps of {len(AGENTS)} agents")
    slowest = max(value for name, value in medians.items() if name.startswith("ours"))
    factor = min(value for name, value in medians.items() if name.startswith("RLlib")) / medians["ours, uniform"]
    met = slowest <= MAX_SECONDS and factor >= FASTER
    print(f"slowest of ours {1e3 * slowest:.3f} ms, target 1 ms; {factor:.0f}× RLlib's fastest, target {FASTER:g}×")
    print("met" if met else "MISSED")
    return not met


if __name__ == "__main__":
    sys.exit(main())
