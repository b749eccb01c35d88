"""Wraps the private and undocumented parts of RLlib, Tune and torch, the only place that uses them.

Each function or class names the internal or the upstream fault that it relies on, as of Ray 2.60 and torch 2.13.
tests/upgrade/test_rllib.py fails where an internal has changed, tests/upgrade/test_rllib_faults.py where a fault has
been fixed upstream.
"""

import logging
import os
import signal
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import ray
import torch
from numpy.typing import NDArray
from ray.rllib.algorithms.algorithm import Algorithm
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.learner.training_data import TrainingData as TrainingData
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.utils.checkpoints import Checkpointable
from ray.tune.execution.class_cache import _ActorClassCache
from ray.tune.experiment import Trial
from ray.tune.logger.tensorboardx import TBXLoggerCallback
from ray.tune.search.variant_generator import generate_variants as generate_variants

from league.errors import ConfigError

# Episodes


class EpisodeChunk(SingleAgentEpisode):
    """Consecutive steps of one agent in one episode, with the observation that follows the last step.

    Overrides the undocumented `validate`: RLlib compares the lengths of all columns for every chunk, which takes longer
    than building it. The recorder slices all columns of a chunk alike.
    """

    __slots__ = ()

    def validate(self) -> None:
        """Do nothing."""


class ChunkColumn(InfiniteLookbackBuffer):
    """A column of an EpisodeChunk, without a space.

    Overrides the property `space` and sets `_space` and `_space_struct`: RLlib takes apart the space of each column,
    even if it is None.
    """

    @property
    def space(self) -> Any:
        return self._space

    @space.setter
    def space(self, value: Any) -> None:
        if value is None:
            self._space = self._space_struct = None
        else:
            InfiniteLookbackBuffer.space.fset(self, value)


# Components of checkpoints


def includes_component(
    owner: Checkpointable, name: str, components: str | Collection[str] | None, excluded: str | Collection[str] | None
) -> bool:
    """Return whether `get_state` was asked for a component. Calls the private `Checkpointable._check_component`."""
    return bool(owner._check_component(name, components, excluded))


def subcomponents(owner: Checkpointable, name: str, components: str | Collection[str] | None) -> Any:
    """Return the parts of component `name` among `components`. Calls `Checkpointable._get_subcomponents`."""
    return owner._get_subcomponents(name, components)


# Modules, learners and runners


class ExactStateModule(TorchRLModule):
    """A TorchRLModule whose state keeps its dtypes.

    `TorchRLModule.get_state` converts float64 to float32, which loses precision of observation statistics.
    """

    def train(self, mode: bool = True) -> "ExactStateModule":
        """Set the training mode. RLlib calls this at every forward pass; it walks all submodules only on a change."""
        return self if self.training == mode else super().train(mode)

    def get_state(self, *_: Any, **__: Any) -> dict[str, NDArray]:
        """Return the weights and buffers by name."""
        return {name: np.array(value.detach().cpu()) for name, value in self.state_dict().items()}

    def set_state(self, state: dict[str, NDArray]) -> None:
        """Load what `get_state` returned."""
        self.load_state_dict({name: torch.tensor(array) for name, array in state.items()})


class FixedPoliciesLearner(TorchLearner):
    """A TorchLearner that runs its own update loop for a fixed set of policies."""

    @property
    def weights_version(self) -> int:
        """The number that runners receive along with the weights. Stored as the private `_weights_seq_no`."""
        return int(self._weights_seq_no)

    @weights_version.setter
    def weights_version(self, number: int) -> None:
        self._weights_seq_no = number

    def build(self) -> None:
        """Raises ConfigError if a GPU is requested and none is available. RLlib's error does not name the setting."""
        if self.config.num_gpus_per_learner and not torch.cuda.is_available():
            raise ConfigError(
                f"training.gpus: {self.config.num_gpus_per_learner:g} requested for the learner, but torch finds no GPU"
            )
        super().build()

    def configure_optimizers_for_module(self, module_id: str, config: AlgorithmConfig | None = None) -> None:
        """Raise NotImplementedError. RLlib calls this from `add_module` only."""
        raise NotImplementedError(f"the policies of a league are fixed: cannot add {module_id}")

    def _log_trainable_parameters(self) -> None:
        """Do nothing. RLlib logs the counts once and reports them as NaN in every later update."""


class RaisingEnvRunner(EnvRunner, Checkpointable):
    """An EnvRunner whose exceptions reach the algorithm.

    Overrides the undocumented `apply`: RLlib's ends the process on an exception and loses its message.
    """

    def apply(self, func: Any, *args: Any, **kwargs: Any) -> Any:
        """Call `func` with this runner as its first argument."""
        return func(self, *args, **kwargs)


# Algorithms


class NoResultsDirectory:
    """Mixin for Algorithms.

    Overrides the private `Trainable._setup_logdir`, which creates a results directory in the user's home.
    """

    def _setup_logdir(self) -> None:
        """Do nothing: Tune creates the directories of a run."""


class ExplicitConfig(AlgorithmConfig):
    """An AlgorithmConfig with an explicit module specification and learner class.

    RLlib calls these two methods even if the configuration overrides both defaults; its base class raises.
    """

    def get_default_rl_module_spec(self) -> RLModuleSpec:
        """Return a placeholder."""
        return RLModuleSpec(module_class=TorchRLModule)

    def get_default_learner_class(self) -> type[TorchLearner]:
        """Return a placeholder."""
        return TorchLearner


fused_adam = torch._fused_adam_
"""The kernel of `torch.optim.Adam.step`, which prepares for several tensors for as long."""


def local_learner(algorithm: Algorithm) -> Any:
    """Return the learner in the algorithm's process (`num_learners=0`). Reads the private `LearnerGroup._learner`."""
    return algorithm.learner_group._learner


def wait_for_runners(algorithm: Algorithm) -> None:
    """Wait until all remote runners answer.

    `EnvRunnerGroup.sync_weights` skips a runner that has not answered the previous call, such as one that is still
    starting: after restoring a checkpoint it would keep playing with its initial weights.
    """
    algorithm.env_runner_group.foreach_env_runner("ping", local_env_runner=False)


def remote_traceback(error: BaseException) -> str:
    """Return the traceback of another process. Reads the undocumented `RayTaskError.traceback_str`."""
    return str(getattr(error, "traceback_str", ""))


# Tune


class TensorBoardWriter(TBXLoggerCallback):
    """Writes selected scalars of each trial to the trial's own directory.

    Replaces the behaviour of Tune's logger, which writes every item of a result into one group and flushes rarely.
    Uses the private `_trial_writer`, `_trial_result` and `_summary_writer_cls`, and `Trial.init_local_path`.
    """

    def log_trial_start(self, trial: Trial) -> None:
        trial.init_local_path()
        self._trial_writer[trial] = self._summary_writer_cls(trial.path, flush_secs=30)
        self._trial_result[trial] = {}

    def write(self, trial: Trial, scalars: Mapping[str, float], step: int) -> None:
        """Write scalars at a step, and keep them for the table of hyperparameters that Tune writes at the end."""
        if trial not in self._trial_writer:
            self.log_trial_start(trial)
        for name, value in scalars.items():
            self._trial_writer[trial].add_scalar(name, value, global_step=step)
        self._trial_writer[trial].flush()
        self._trial_result[trial] = self._trial_result[trial] | scalars


class NotPickled:
    """Mixin for callbacks and stoppers.

    Tune pickles them for its own way of resuming, which is not used here; they hold locks and connections.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {}


TUNE_ENVIRONMENT = {
    "RAY_CHDIR_TO_TRIAL_DIR": "0",  # keep the working directory, where a user's environment is importable
    "RAY_AIR_NEW_OUTPUT": "0",
    "TUNE_PRINT_ALL_TRIAL_ERRORS": "0",
    "TUNE_DISABLE_SIGINT_HANDLER": "1",  # Tune's handler ends trials without a checkpoint
    "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1",  # before the first episode ends there is no return
}
LOG_LEVELS = {"ray._common.deprecation": logging.ERROR, "ray.tune": logging.CRITICAL}
JOB_LOGGERS = (
    *("ray.dashboard.modules.job.sdk", "ray.dashboard.modules.dashboard_sdk"),
    "ray._private.runtime_env.packaging",
)
NO_JOB_AGENT = "No available agent"
"""Part of Ray's error message while a new cluster does not accept jobs yet."""


def silence_tune() -> None:
    """Turn off Tune's tables, hints and tracebacks, and RLlib's warnings about its own deprecated calls.

    Sets undocumented environment variables and the levels of private loggers.
    """
    os.environ.update(TUNE_ENVIRONMENT)
    for name, level in LOG_LEVELS.items():
        logging.getLogger(name).setLevel(level)


def use_waiting_workers() -> None:
    """Let Tune start trials without a runtime environment, in a worker that already waits for a task.

    Only for a local Ray, whose workers inherit the variables that Tune would set. Replaces the private
    `_ActorClassCache.get`.
    """
    _ActorClassCache.get = lambda cache, trainable: cache._cache.setdefault(trainable, ray.remote(trainable))


def silence_job_submission() -> None:
    """Turn off what Ray's job client logs about packaging and uploads. Sets the levels of private loggers."""
    for name in JOB_LOGGERS:
        logging.getLogger(name).setLevel(logging.ERROR)


@contextmanager
def restored_sigusr1() -> Iterator[None]:
    """Restore the SIGUSR1 handler afterwards: `tune.run` installs its own and leaves it behind."""
    before = signal.getsignal(signal.SIGUSR1)
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGUSR1, before)
