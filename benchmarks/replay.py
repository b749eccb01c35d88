"""How fast are transitions of three agents stored and sampled, compared with RLlib's multi-agent replay buffer?

Both contain the same 100,000 steps of simple_spread, three agents with 18 numbers each, and sample 1,024 steps of all
three agents: ours from rows of a ring buffer, RLlib's MultiAgentEpisodeReplayBuffer from episodes, in the mode that
keeps agents together (`synchronized`) and in its default mode, which draws agents' steps independently. Median of the
calls in a round; compared measurements alternate; one thread.
"""

import statistics
import timeit
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from ray.rllib.env.multi_agent_episode import MultiAgentEpisode
from ray.rllib.utils.replay_buffers.multi_agent_episode_buffer import MultiAgentEpisodeReplayBuffer

from benchmarks.harness import Quick, Target, in_rounds
from league.config.off_policy import PrioritiesConfig
from training.replay_buffer import ReplayBuffer, TransitionBlock

STEPS, BATCH, LENGTH, NUMBERS = 100_000, 1024, 25, 18
AGENTS = ("agent_0", "agent_1", "agent_2")
MAX_MILLISECONDS, FASTER = 1.0, 50.0


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


def main(quick: Quick = False) -> Iterator[Target]:
    """Measure the buffers in turn."""
    uniform, prioritised = our_buffer(None), our_buffer(PrioritiesConfig())
    buffer = rllib_buffer(STEPS // 10 if quick else STEPS)
    samples: dict[str, Callable[[], object]] = {
        "uniform": lambda: uniform.sample(BATCH),
        "uniform, 3 steps": lambda: uniform.sample(BATCH, n_step=3, gamma=0.99),
        "prioritised": lambda: prioritised.sample(BATCH),
        "prioritised, 3 steps": lambda: prioritised.sample(BATCH, n_step=3, gamma=0.99),
        "RLlib, synchronized": lambda: buffer.sample(BATCH, replay_mode="synchronized"),
        "RLlib, independent": lambda: buffer.sample(BATCH * len(AGENTS), replay_mode="independent"),
    }

    def measure(name: str) -> float:
        return statistics.median(timeit.repeat(samples[name], number=1, repeat=5 if "RLlib" in name else 100))

    medians = in_rounds({name: partial(measure, name) for name in samples}, 2 if quick else 5)
    for name, seconds in medians.items():
        yield Target(name, round(1e3 * seconds, 3), "ms", at_most=None if "RLlib" in name else MAX_MILLISECONDS)
    fastest = min(seconds for name, seconds in medians.items() if "RLlib" in name)
    yield Target("uniform", fastest / medians["uniform"], "×", at_least=FASTER, peer="RLlib's fastest")
