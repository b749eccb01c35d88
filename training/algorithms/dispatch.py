"""The algorithm that a league's `training.algorithm` names."""

from importlib import import_module
from typing import Any

from ray.rllib.algorithms.algorithm_config import AlgorithmConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec

from league.config import LeagueConfig
from league.interface import Interface
from league.settings import Storage
from league.training_config import AnyTraining


def algorithm_config(league: LeagueConfig, interface: Interface, storage: Storage | None = None) -> AlgorithmConfig:
    """RLlib's configuration of a league's training.

    storage: where the versions are that play as opponents; not needed without. Raises ConfigError where settings do
    not fit the league.
    """
    return _module(league.training).algorithm_config(league, interface, storage)


def module_spec(settings: AnyTraining, interface: Interface) -> MultiRLModuleSpec:
    """The modules of all policies, `training.modules.acting.Acting` each. Raises ConfigError for spaces that they
    cannot have."""
    return _module(settings).module_spec(settings, interface)


def _module(settings: AnyTraining) -> Any:
    """`training/algorithms/<name>.py`, which has both functions. Only what is trained is imported."""
    return import_module(f"training.algorithms.{settings.algorithm}")
