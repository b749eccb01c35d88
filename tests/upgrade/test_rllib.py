"""Private parts of Ray that training/rllib_compat.py uses exist in the installed version."""

import inspect
from typing import Any

import pytest
import ray
from ray._private.runtime_env import packaging
from ray.dashboard.modules import dashboard_sdk
from ray.dashboard.modules.job import job_head, sdk
from ray.exceptions import RayTaskError
from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.learner.learner_group import LearnerGroup
from ray.rllib.core.learner.torch.torch_learner import TorchLearner
from ray.rllib.core.rl_module.torch import TorchRLModule
from ray.rllib.env.env_runner import EnvRunner
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.env.utils.infinite_lookback_buffer import InfiniteLookbackBuffer
from ray.rllib.utils.checkpoints import Checkpointable
from ray.tune import tune
from ray.tune.execution import tune_controller
from ray.tune.execution.class_cache import _ActorClassCache
from ray.tune.experiment import Trial
from ray.tune.experimental import output
from ray.tune.logger.tensorboardx import TBXLoggerCallback
from ray.tune.trainable import Trainable

from training import rllib_compat

pytestmark = pytest.mark.slow

INTERNALS: list[tuple[str, Any, str]] = [
    ("use_waiting_workers", tune_controller.TuneController, "self._class_cache.get(trainable_cls)"),
    ("use_waiting_workers", _ActorClassCache, "ray.remote(runtime_env=runtime_env)(trainable_cls)"),
    ("EpisodeChunk", SingleAgentEpisode.__init__, "self.validate()"),
    ("ChunkColumn", InfiniteLookbackBuffer, "self._space_struct = get_base_struct_from_space(value)"),
    (
        "includes_component",
        Checkpointable._check_component,
        "(self, name, components, not_components)",
    ),
    ("subcomponents", Checkpointable._get_subcomponents, "(self, name, components)"),
    ("ExactStateModule", TorchRLModule.get_state, "convert_to_numpy(state_dict)"),
    ("FixedPoliciesLearner.weights_version", TorchLearner.get_state, "WEIGHTS_SEQ_NO: self._weights_seq_no"),
    ("FixedPoliciesLearner", TorchLearner._log_trainable_parameters, "self.metrics.log_dict("),
    ("RaisingEnvRunner", EnvRunner.apply, "sys.exit(1)"),
    ("NoResultsDirectory", Trainable.__init__, "self._setup_logdir()"),
    ("ExplicitConfig", AlgorithmConfig.rl_module_spec.fget, "self.get_default_rl_module_spec()"),
    ("ExplicitConfig", AlgorithmConfig.get_default_rl_module_spec, "raise NotImplementedError"),
    ("local_learner", LearnerGroup.__init__, "self._learner = learner_class("),
    ("remote_traceback", RayTaskError.__init__, "self.traceback_str = traceback_str"),
    ("TensorBoardWriter", TBXLoggerCallback.__init__, "self._trial_writer"),
    ("TensorBoardWriter", TBXLoggerCallback.__init__, "self._summary_writer_cls = SummaryWriter"),
    ("TensorBoardWriter", TBXLoggerCallback.log_trial_end, "self._trial_result[trial]"),
    ("TensorBoardWriter", Trial.init_local_path, "self.relative_logdir"),
    ("TUNE_ENVIRONMENT", tune, '"TUNE_DISABLE_SIGINT_HANDLER"'),
    ("TUNE_ENVIRONMENT", output, '"RAY_AIR_NEW_OUTPUT"'),
    ("TUNE_ENVIRONMENT", tune_controller, '"TUNE_PRINT_ALL_TRIAL_ERRORS"'),
    ("TUNE_ENVIRONMENT", tune_controller, '"TUNE_DISABLE_STRICT_METRIC_CHECKING"'),
    ("TUNE_ENVIRONMENT", Trainable, "RAY_CHDIR_TO_TRIAL_DIR"),
    ("NO_JOB_AGENT", job_head, rllib_compat.NO_JOB_AGENT),
    ("restored_sigusr1", tune, "signal.signal(signal.SIGUSR1"),
]


def test_each_internal_still_exists_upstream(subtests: pytest.Subtests) -> None:
    for user, upstream, code in INTERNALS:
        name = getattr(upstream, "__qualname__", None) or upstream.__name__
        with subtests.test(user, code=code):
            assert code in inspect.getsource(upstream), (
                f"Ray {ray.__version__} has changed {name}, which rllib_compat.{user} relies on: `{code}` is gone"
            )


def test_the_loggers_still_exist_upstream() -> None:
    loggers = {sdk.logger.name, dashboard_sdk.logger.name, packaging.default_logger.name}
    assert set(rllib_compat.JOB_LOGGERS) == loggers
