"""Decides how many processes, threads and environments a run uses, where its configuration says `auto`.

With PPO, runners sample while the learner updates (`training.lag`). How many of the cores sample depends on what
sampling costs in relation to learning: see SHARES. There are no more runners than leave each agent STEPS_PER_BATCH
steps of each environment per batch. With small minibatches, a GPU or many cores are no faster than a few cores:
batches are scaled. There is one learner. Off-policy algorithms sample in short rounds, in the learner's process; a
stock environment has runners if each of them steps its environments at least once per round.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from typing import Final, Literal

from league.config.league import LeagueConfig
from league.config.off_policy import OffPolicyConfig
from league.config.ppo import PPOConfig
from league.config.training import MAX_BATCH_SCALE, TrainingSettings
from league.environments.implementation import STOCK_ENVS, VECTOR_ENVS, implementation

Sampling = Literal["vectorised", "taught", "stock"]
SHARES: dict[Sampling, tuple[Fraction, str]] = {
    "vectorised": (Fraction(1, 8), "sampling a vectorised environment takes an eighth of the cores"),
    "taught": (Fraction(1, 2), "the teacher acts in the runners: half of the cores sample"),
    "stock": (Fraction(7, 8), "a step of a stock environment takes longer than learning from it"),
}
"""What is sampled → the part of the cores that sample while the learner updates, and why."""
STEPS_PER_BATCH = 16
"""Minimum number of steps of an agent in each environment per batch: advantages of shorter chunks are mostly guesses of
the value function."""
FEWEST_STOCK_ENVS, FEWEST_VECTOR_ENVS = 2, 8
"""Minimum number of environments of a runner: with fewer, most of its time goes into forward passes of a few rows."""
MAX_THREADS = 4
"""More do not accelerate networks of a few hundred units."""
SCALED_ROWS_PER_CORE, MOST_SCALED_ROWS, SCALED_ROWS_OF_GPU = 256, 4096, 8192
"""Steps of a scaled minibatch: for each core, at most in total, and on a GPU, where a gradient step of 512 rows takes
as long as one of some thousands."""
FEWEST_SCALED_CORES = 4
FEWEST_UPDATES = 128
"""Minimum number of updates of a run whose batches are scaled."""
WIDE = 1024
"""Units of a hidden layer from which a GPU is faster with minibatches as configured."""

Nodes = Sequence[Mapping[str, float]]
"""The resources `CPU` and `GPU` of each node."""
AUTO: Final = "auto"
ONE_CORE: Nodes = ({"CPU": 1.0},)


@dataclass(frozen=True, slots=True)
class Resources:
    """What a run uses: the settings of `training` with these names, as numbers."""

    runners: int
    num_envs: int
    threads: int
    gpus: float
    runner_gpus: float = 0.0
    learners: int = 1
    batch_scale: int = 1

    @property
    def processes(self) -> int:
        """Number of learners and runners."""
        return self.learners + self.runners

    @property
    def settings(self) -> dict[str, float]:
        """The settings of `training`."""
        return asdict(self)


def resources(league: LeagueConfig, agents: int, nodes: Nodes = ONE_CORE) -> Resources:
    """Return what a run uses: the numbers in its configuration, and for `auto` what fits the nodes.

    Args:
        league: The league and its training settings.
        agents: Number of agents of the environment.
        nodes: Where the run trains.
    """
    return _choose(league, agents, nodes)[0]


def describe(league: LeagueConfig, agents: int, nodes: Nodes) -> str:
    """Return in one line what the nodes have, what a run uses of it, and why."""
    used, reasons = _choose(league, agents, nodes)
    there = _count(_cores(nodes), "core")
    if gpus := sum(node.get("GPU", 0.0) for node in nodes):
        there += f", {_count(gpus, 'GPU')}"
    sampling = _count(used.num_envs, "environment")
    if used.runners:
        sampling = f"{_count(used.runners, 'runner')} of {sampling}"
    else:
        sampling += " in the learner's process"
    learner = (
        f"{'a learner' if used.learners == 1 else f'{used.learners} learners'} of {_count(used.threads, 'thread')}"
    )
    if used.gpus:
        learner += f" and {_count(used.gpus, 'GPU')}"
    if used.batch_scale > 1:
        learner += f", batches of {used.batch_scale} times the configured size"
    why = f" ({'; '.join(reasons)})" if reasons else ""
    return f"{there}: {sampling}, {learner}{why}."


def _choose(league: LeagueConfig, agents: int, nodes: Nodes) -> tuple[Resources, list[str]]:
    """Return what a run uses, and the reasons of what is chosen automatically."""
    settings, reasons = league.training, list[str]()
    is_taught = isinstance(settings, PPOConfig) and settings.teacher is not None
    sampling: Sampling = "taught" if is_taught else "vectorised"
    is_random = any(stage.is_random for stage in settings.curriculum)
    if is_random or implementation(league.training_environment).vector is None:
        sampling = "stock"
    gpus = settings.gpus
    if gpus == AUTO:
        gpus, reason = _gpus(settings, nodes)
        reasons += [reason] if reason else []
    batch_scale = settings.batch_scale
    if batch_scale == AUTO:
        batch_scale = _batch_scale(settings, sampling, _cores(nodes), on_gpu=gpus > 0)
    settings = scaled(settings, batch_scale)
    learners = 1 if settings.learners == AUTO else settings.learners
    runners, is_external = settings.runners, league.environment.external is not None
    if runners == AUTO and is_external:
        runners = int(_overlaps(settings) and _cores(nodes) > 1)
        reasons.append("one process serves all simulators")
    elif runners == AUTO:
        runners, reason = _runners(settings, sampling, agents, _cores(nodes), learners if gpus else 0)
        reasons.append(reason)
    num_envs = settings.num_envs
    if num_envs == AUTO:
        num_envs = _num_envs(settings, "vectorised" if is_external else sampling, agents, runners)
    threads = settings.threads
    if threads == AUTO:
        threads = _threads(nodes, runners if _overlaps(settings) else 0, learners)
    return Resources(runners, num_envs, threads, gpus, settings.runner_gpus, learners, batch_scale), reasons


def scaled(settings: TrainingSettings, batch_scale: int) -> TrainingSettings:
    """Return the settings with larger batches. The learning rate is that of the learner (training/learners/ppo.py)."""
    if not isinstance(settings, PPOConfig):
        return settings
    sizes = {name: getattr(settings, name) * batch_scale for name in ("train_batch_size", "minibatch_size")}
    return settings.model_copy(update=sizes)


def _cores(nodes: Nodes) -> int:
    return max(1, int(sum(node.get("CPU", 0.0) for node in nodes)))


def _overlaps(settings: TrainingSettings) -> bool:
    """Return whether runners sample while the learner updates."""
    return isinstance(settings, PPOConfig) and settings.lag > 0


def _gpus(settings: TrainingSettings, nodes: Nodes) -> tuple[float, str]:
    """Return the GPUs of the learner, and why it has none although there are some."""
    available = max((node.get("GPU", 0.0) for node in nodes if node.get("CPU", 0.0)), default=0.0)
    if not available or settings.runner_gpus:
        return 0.0, ""
    if isinstance(settings, OffPolicyConfig):
        return 0.0, f"{settings.algorithm} learns from small batches, faster on the CPU"
    if settings.convolutions or settings.network is not None or max(settings.hidden) >= WIDE:
        return min(1.0, available), ""
    return 0.0, "a small network learns faster on the CPU"


def _batch_scale(settings: TrainingSettings, sampling: Sampling, cores: int, *, on_gpu: bool) -> int:
    """Return the factor of the batches, a power of two."""
    if not isinstance(settings, PPOConfig) or sampling == "stock" or (cores < FEWEST_SCALED_CORES and not on_gpu):
        return 1
    rows = SCALED_ROWS_OF_GPU if on_gpu else min(SCALED_ROWS_PER_CORE * cores, MOST_SCALED_ROWS)
    most = min(rows // settings.minibatch_size, MAX_BATCH_SCALE)
    if settings.max_steps is not None:
        most = min(most, settings.max_steps // (FEWEST_UPDATES * settings.train_batch_size))
    return 1 << max(0, most.bit_length() - 1)


def _runners(
    settings: TrainingSettings, sampling: Sampling, agents: int, cores: int, gpu_learners: int
) -> tuple[int, str]:
    """Return the number of runners, and why. gpu_learners: the learners on GPUs, of which each needs a core."""
    if cores == 1:
        return 0, "one core samples and learns in turn"
    if isinstance(settings, OffPolicyConfig):
        envs = STOCK_ENVS if settings.num_envs == AUTO else settings.num_envs
        runners = min(cores - 1, settings.update_every // envs) if sampling == "stock" else 0
        if runners > 1:
            return runners, "each runner steps its environments once per round"
        return 0, f"rounds of {settings.algorithm} are too short for runners"
    assert isinstance(settings, PPOConfig)
    if not _overlaps(settings):
        if sampling == "vectorised":
            return 0, "without a lag, sampling a vectorised environment is too short for runners"
        runners, reason = cores, "without a lag, all cores sample, then learn"
    elif gpu_learners:
        runners, reason = max(1, cores - gpu_learners), "the learner is on the GPU: all other cores sample"
    else:
        share, reason = SHARES[sampling]
        runners = max(1, round(cores * share))
    fewest = _fewest_envs(sampling) if settings.num_envs == AUTO else settings.num_envs
    most = max(1, _fitting_envs(settings, agents) // fewest)
    if runners <= most:
        return runners, reason
    return most, f"more runners would get batches of less than {STEPS_PER_BATCH} steps of {fewest} environments"


def _threads(nodes: Nodes, samplers: int, learners: int) -> int:
    """Return the threads of each learner, on whichever node it is. samplers: cores that sample at the same time."""
    of_node = min((int(node["CPU"]) for node in nodes if node.get("CPU", 0.0) >= 1), default=1)
    return max(1, min((_cores(nodes) - samplers) // learners, of_node, MAX_THREADS))


def _num_envs(settings: TrainingSettings, sampling: Sampling, agents: int, runners: int) -> int:
    """Return the number of parallel environments of a runner."""
    if not isinstance(settings, PPOConfig):
        return STOCK_ENVS
    fitting = _fitting_envs(settings, agents) // max(runners, 1)
    return min(max(fitting, _fewest_envs(sampling)), STOCK_ENVS if sampling == "stock" else VECTOR_ENVS)


def _fitting_envs(settings: PPOConfig, agents: int) -> int:
    """Return the number of environments of all runners of which each agent gets STEPS_PER_BATCH steps per batch."""
    return settings.train_batch_size // (agents * STEPS_PER_BATCH)


def _fewest_envs(sampling: Sampling) -> int:
    return FEWEST_STOCK_ENVS if sampling == "stock" else FEWEST_VECTOR_ENVS


def _count(number: float, noun: str) -> str:
    return f"{number:g} {noun}{'' if number == 1 else 's'}"
