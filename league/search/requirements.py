"""Which environments can be searched."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.implementation import implementation
from league.environments.vector.copying import LONGEST, Twins
from league.environments.vector.differences import EnvironmentsDiffer
from league.environments.vector.random_actions import random_steps
from league.environments.vector.vector_env import VectorEnv
from league.errors import EnvironmentMismatch, ObservationError
from league.interface import Interface
from league.spaces import Discrete, Space

GAMES, ROUNDING = 64, 1e-6


def searchable(config: EnvironmentConfig, interface: Interface) -> Callable[[int], VectorEnv]:
    """Return a function of the number of copies that creates the vectorised environment of a league, after tests.

    Search versions play games of two agents whose returns are from -1 to 1 and sum to 0, from positions that
    observations show.

    Raises:
        EnvironmentMismatch: The environment cannot be searched; says why.
    """
    choice = implementation(config)
    if interface.hidden_information or interface.simultaneous:
        raise _refused(config, "agents do not see everything that others know or do")
    if choice.vector is None:
        raise _refused(config, f"only vectorised environments can be searched. {choice.reason}")
    actions = [spaces.action for spaces in interface.agents.values()]
    if len(actions) != 2:
        raise _refused(config, f"it has {len(actions)} agents, expected 2")
    if not isinstance(actions[0], Discrete) or any(action != actions[0] for action in actions):
        raise _refused(config, "the agents do not have the same discrete actions")
    make: Callable[[int], VectorEnv] = partial(choice.vector, **config.kwargs)
    twins = Twins(make, actions)
    for check, method, fault in (
        (twins.check_copying, "copy", "its VectorEnv.copy does not copy everything"),
        (twins.check_without_chance, "step", "its games depend on chance"),
        (twins.check_restoring, "restore", "its observations do not show everything"),
    ):
        try:
            check()
        except NotImplementedError as error:
            raise _refused(config, f"its vectorised environment does not implement VectorEnv.{method}") from error
        except (EnvironmentsDiffer, ObservationError) as error:
            raise _refused(config, f"{fault}: {error}") from error
    returns = _returns(make(GAMES), actions)
    if (np.abs(returns.sum(axis=1)) > ROUNDING).any() or (np.abs(returns) > 1 + ROUNDING).any():
        raise _refused(config, "the returns of its agents are not from -1 to 1 with the sum 0")
    return make


def _returns(env: VectorEnv, actions: Sequence[Space]) -> NDArray[np.float64]:
    """Return the returns of all agents in random games, (copies, agents)."""
    rng, copies = np.random.default_rng(0), np.arange(env.num_envs)
    returns = np.zeros((env.num_envs, len(actions)))
    for rows in random_steps(env.step, env.reset(copies, copies), actions, rng, LONGEST):
        for block in rows:
            returns[block.envs, block.agents] += block.rewards
    return returns


def _refused(config: EnvironmentConfig, reason: str) -> EnvironmentMismatch:
    return EnvironmentMismatch(f"{config.entry_point} cannot be searched: {reason}")
