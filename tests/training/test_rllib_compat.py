"""Private parts of Ray are used in training/rllib_compat.py only, and exist in the installed version."""

import ast
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ray
import torch
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

import training
from training import rllib_compat

COMPAT = "training.rllib_compat"
DOCUMENTED = {
    *("ray", "ray.tune", "ray.tune.registry", "ray.tune.schedulers", "ray.tune.experiment", "ray.job_submission"),
    *("ray.tune.search", "ray.tune.search.optuna"),
    *("ray.exceptions", "ray.rllib.core", "ray.rllib.core.columns", "ray.rllib.core.learner.learner"),
    *("ray.rllib.algorithms", "ray.rllib.algorithms.algorithm", "ray.rllib.algorithms.algorithm_config"),
    *("ray.rllib.core.rl_module.rl_module", "ray.rllib.core.rl_module.multi_rl_module"),
    *("ray.rllib.core.rl_module.torch", "ray.rllib.core.rl_module.apis.value_function_api"),
    *("ray.rllib.env.env_runner", "ray.rllib.env.multi_agent_env", "ray.rllib.env.single_agent_episode"),
    *("ray.rllib.utils.metrics", "ray.rllib.utils.metrics.metrics_logger", "ray.rllib.utils.checkpoints"),
    "ray.util.scheduling_strategies",
}
"""Modules of Ray's API reference and of its documented examples."""
OVERRIDES = {"_forward", "_forward_exploration", "_forward_inference", "_forward_train"}
"""Methods that the documentation of RLModule tells subclasses to override."""


def modules() -> dict[str, ast.Module]:
    root = Path(training.__file__).parent
    names = {path: ".".join(("training", *path.relative_to(root).with_suffix("").parts)) for path in root.rglob("*.py")}
    return {name: ast.parse(path.read_text()) for path, name in names.items()}


def ray_imports(tree: ast.AST) -> Iterator[str]:
    """The modules of Ray that a module imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "ray":
            yield str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "ray")


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def defined_names(tree: ast.AST) -> set[str]:
    """Names that the functions, classes and assignments of a tree define, including attributes of `self`."""
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.Name(id=name, ctx=ast.Store()):
                names.add(name)
            case ast.Attribute(attr=name, ctx=ast.Store(), value=ast.Name(id="self")):
                names.add(name)
    return names


def test_only_rllib_compat_imports_undocumented_modules_of_ray() -> None:
    found = {
        f"{name}: {imported}"
        for name, tree in modules().items()
        for imported in ray_imports(tree)
        if name != COMPAT and imported not in DOCUMENTED
    }
    assert not found, "move these imports to training/rllib_compat.py"


def test_only_rllib_compat_names_private_modules_of_ray() -> None:
    found = {
        f"{name}:{node.lineno}"
        for name, tree in modules().items()
        for node in ast.walk(tree)
        if name != COMPAT and isinstance(node, ast.Constant) and str(node.value).startswith(("ray._", "ray.tune."))
    }
    assert not found, "move these names to training/rllib_compat.py"


def test_only_rllib_compat_reads_private_attributes_that_training_does_not_define() -> None:
    trees = modules()
    own = set().union(*(defined_names(tree) for name, tree in trees.items() if name != COMPAT)) | OVERRIDES
    found = {
        f"{name}:{node.lineno} {ast.unparse(node)}"
        for name, tree in trees.items()
        for node in ast.walk(tree)
        if name != COMPAT and isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in own
    }
    assert not found, "add a function to training/rllib_compat.py"


def test_only_rllib_compat_overrides_private_methods_of_ray() -> None:
    found = set()
    for info in pkgutil.walk_packages(training.__path__, "training."):
        module = importlib.import_module(info.name)
        for _, cls in inspect.getmembers(module, inspect.isclass):
            upstream = [vars(base) for base in cls.__mro__ if base.__module__.split(".")[0] == "ray"]
            if cls.__module__ == info.name != COMPAT:
                private = {name for name in vars(cls) if is_private(name)} - OVERRIDES - {"_abc_impl"}
                found |= {f"{cls.__qualname__}.{name}" for name in private if any(name in base for base in upstream)}
    assert not found, "move these overrides to training/rllib_compat.py"


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


@pytest.mark.parametrize(("user", "upstream", "code"), INTERNALS)
def test_the_internal_still_exists_upstream(user: str, upstream: Any, code: str) -> None:
    name = getattr(upstream, "__qualname__", None) or upstream.__name__
    assert code in inspect.getsource(upstream), (
        f"Ray {ray.__version__} has changed {name}, which training.rllib_compat.{user} relies on: `{code}` is gone"
    )


def test_the_loggers_still_exist_upstream() -> None:
    loggers = {sdk.logger.name, dashboard_sdk.logger.name, packaging.default_logger.name}
    assert set(rllib_compat.JOB_LOGGERS) == loggers


def test_rllib_still_rounds_doubles_of_a_modules_state() -> None:
    class Statistics(TorchRLModule):
        def setup(self) -> None:
            self.register_buffer("mean", torch.tensor([1e9 + 0.125], dtype=torch.float64))

    class Exact(rllib_compat.ExactStateModule, Statistics):
        pass

    module = Exact()
    assert module.get_state()["mean"].dtype == np.float64
    # UPSTREAM: ExactStateModule can be removed if this fails.
    assert TorchRLModule.get_state(module)["mean"].dtype == np.float32


def test_a_chunks_column_has_no_space_and_is_not_copied() -> None:
    data = np.arange(3)
    column = rllib_compat.ChunkColumn(data)
    assert column.space is None
    assert column.space_struct is None
    assert column.data is data
