"""What `training.rllib_compat` changes of RLlib. The internals that it uses: `tests/upgrade/test_rllib.py`."""

import importlib
import inspect
import pkgutil

import numpy as np
import torch
from ray.rllib.core.rl_module.torch import TorchRLModule

import training
from scripts.checks.layout import OVERRIDES
from training import rllib_compat


def test_only_rllib_compat_overrides_private_methods_of_ray() -> None:
    overridden = set()
    for info in pkgutil.walk_packages(training.__path__, "training."):
        module = importlib.import_module(info.name)
        for _, cls in inspect.getmembers(module, inspect.isclass):
            upstream = [vars(base) for base in cls.__mro__ if base.__module__.split(".")[0] == "ray"]
            if cls.__module__ == info.name != rllib_compat.__name__:
                private = (
                    {name for name in vars(cls) if name[0] == "_" and name[:2] != "__"} - OVERRIDES - {"_abc_impl"}
                )
                overridden |= {
                    f"{cls.__qualname__}.{name}" for name in private if any(name in base for base in upstream)
                }
    assert overridden == set(), "move these overrides to training/rllib_compat.py"


class Statistics(TorchRLModule):
    def setup(self) -> None:
        self.register_buffer("mean", torch.tensor([1e9 + 0.125], dtype=torch.float64))


def test_doubles_of_a_modules_state_are_exact() -> None:
    class Exact(rllib_compat.ExactStateModule, Statistics):
        pass

    assert Exact().get_state()["mean"] == np.array([1e9 + 0.125])
    assert Statistics().get_state()["mean"].dtype == np.float32, "ExactStateModule is not needed any more"


def test_a_chunks_column_has_no_space_and_is_not_copied() -> None:
    data = np.arange(3)
    column = rllib_compat.ChunkColumn(data)
    assert column.space is None
    assert column.space_struct is None
    assert column.data is data
