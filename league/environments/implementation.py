"""Chooses between the stock environment in lockstep and a vectorised environment, which is faster and equal to it."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from league.config.environment import EnvironmentConfig
from league.entry_points import import_entry_point
from league.environments.building import agent_interface, build
from league.environments.copies import StockCopies, VectorCopies
from league.environments.external.stepping import ExternalStepping
from league.environments.lockstep import Lockstep
from league.environments.stepping import BatchedEnvironment
from league.environments.vector.vector_env import UnsupportedArguments, VectorEnv
from league.environments.vector_wrapping import wrapped_vector
from league.environments.wrappers.transforms import UnsupportedWrapper
from league.errors import ConfigError
from league.registry.gateways import ForSimulators
from league.stack import VERIFIED, installed

logger = logging.getLogger(__name__)

STOCK_ENVS, VECTOR_ENVS = 32, 512
"""Parallel environments in lockstep and, at most, in a vectorised environment, if their number is chosen
automatically."""


@dataclass(frozen=True, slots=True)
class Verified:
    """A vectorised environment, as `package.module:Class`, and what it was verified against."""

    vector: str
    api: Literal["aec", "parallel"]
    packages: tuple[str, ...]


VECTOR = "league.environments.vector"
MPE_PACKAGES = ("mpe2", "numpy")
"""The draws of NumPy's generators are reproduced as well."""
VECTORISED = {
    "pettingzoo.classic.connect_four_v3": Verified(f"{VECTOR}.connect_four:ConnectFour", "aec", ("pettingzoo",)),
    "pettingzoo.classic.tictactoe_v3": Verified(f"{VECTOR}.tictactoe:TicTacToe", "aec", ("pettingzoo",)),
    "pettingzoo.classic.rps_v2": Verified(f"{VECTOR}.rps:RockPaperScissors", "parallel", ("pettingzoo",)),
    "pettingzoo.classic.leduc_holdem_v4": Verified(
        f"{VECTOR}.leduc_holdem:LeducHoldem", "aec", ("pettingzoo", "rlcard", "numpy")
    ),
    "mpe2.simple_spread_v3": Verified(f"{VECTOR}.mpe.simple_spread:SimpleSpread", "parallel", MPE_PACKAGES),
    "mpe2.simple_adversary_v3": Verified(f"{VECTOR}.mpe.simple_adversary:SimpleAdversary", "parallel", MPE_PACKAGES),
    "mpe2.simple_tag_v3": Verified(f"{VECTOR}.mpe.simple_tag:SimpleTag", "parallel", MPE_PACKAGES),
}
"""Entry point of the stock environment → its vectorised environment."""


@dataclass(frozen=True, slots=True)
class Implementation:
    """How copies of an environment are stepped. vector: None for lockstep. reason: why, in one sentence."""

    vector: Callable[..., VectorEnv] | None
    reason: str


def implementation(config: EnvironmentConfig) -> Implementation:
    """Return how copies of an environment are stepped. Raises ConfigError if `environment.vector` or a wrapper of a
    vectorised environment is invalid."""
    base = _without_wrappers(config)
    if not config.wrappers or base.vector is None:
        return base
    if other := _if_verified(("supersuit",)):
        return other
    make = base.vector
    try:
        wrapped = wrapped_vector(make, config)
    except UnsupportedWrapper as error:
        return _in_lockstep(str(error))
    names = ", ".join(wrapper.name for wrapper in config.wrappers)
    return Implementation(wrapped, f"It is vectorised by {make.__module__}:{make.__qualname__}, with {names}.")


def _without_wrappers(config: EnvironmentConfig) -> Implementation:
    if config.external is not None:
        external = config.external
        return Implementation(None, f"It runs in the simulator {external.simulator}, version {external.version}.")
    if config.vector is not None:
        return _if_supported(config.vector, config)
    verified = VECTORISED.get(config.entry_point)
    if verified is None:
        return _in_lockstep("it has no vectorised implementation")
    if config.api not in (None, verified.api):
        return _in_lockstep(f"{config.api} is not the vectorised API")
    return _if_verified(verified.packages) or _if_supported(verified.vector, config)


def _in_lockstep(reason: str) -> Implementation:
    return Implementation(None, f"It is stepped in lockstep, because {reason}.")


def _if_verified(packages: Sequence[str]) -> Implementation | None:
    """Return None if the verified versions of these packages are installed."""
    versions = installed()
    for package in packages:
        if versions.get(package) != VERIFIED[package]:
            return _in_lockstep(
                f"the vectorised implementation equals {package} {VERIFIED[package]}, but"
                f" {versions.get(package, 'none')} is installed"
            )
    return None


def stepping(
    config: EnvironmentConfig,
    num_envs: int,
    *,
    crashes: int = 0,
    states: bool = False,
    fast_seeds: bool = False,
    simulators: ForSimulators | None = None,
) -> BatchedEnvironment:
    """Create environments that are stepped together, vectorised if possible. See `stock_stepping`.

    fast_seeds: draw episodes as `VectorEnv.use_fast_seeds` says. Raises ConfigError if that is not possible.
    """
    if fast_seeds:
        check_fast_seeds(config)
    choice = implementation(config)
    logger.info("%s: %s", config.entry_point, choice.reason)
    vector = choice.vector
    if vector is None:
        return stock_stepping(config, num_envs, crashes=crashes, states=states, simulators=simulators)
    make: Callable[[int], VectorEnv] = partial(vector, **config.kwargs)
    return Lockstep(VectorCopies(config, make, num_envs, fast_seeds), states)


def stock_stepping(
    config: EnvironmentConfig,
    num_envs: int,
    *,
    crashes: int = 0,
    render_mode: str | None = None,
    states: bool = False,
    of_seed: Callable[[int], EnvironmentConfig] | None = None,
    simulators: ForSimulators | None = None,
) -> BatchedEnvironment:
    """Create copies of the stock environment that are stepped in lockstep, or by the simulators in which it runs.

    Args:
        config: The environment.
        num_envs: Number of environments.
        crashes: Number of consecutive exceptions after which an environment is recreated; the next one is raised.
        render_mode: PettingZoo's render mode (`rgb_array`, `human`).
        states: Include global states in the results.
        of_seed: The environment of the episode with a seed, with the spaces of `config`: each episode has its own.
        simulators: For what simulators may play. None: somebody watches, for whom they cannot.

    Raises ConfigError if the environment cannot be created, and EnvironmentMismatch if only simulators play the game.
    """
    if config.external is not None:
        env = build(config)
        if simulators is None:
            return env.reset()  # raises an error that says why
        spaces = {agent: agent_interface(env, agent) for agent in env.possible_agents}
        return ExternalStepping(config.external, spaces, num_envs, simulators)
    make_of_seed = None if of_seed is None else lambda seed: build(of_seed(seed), render_mode)
    return Lockstep(StockCopies(lambda: build(config, render_mode), num_envs, crashes, make_of_seed), states)


def check_fast_seeds(config: EnvironmentConfig) -> None:
    """Raise ConfigError if an environment cannot draw its episodes as `VectorEnv.use_fast_seeds` says."""
    choice = implementation(config)
    if choice.vector is not None:
        try:
            choice.vector(1, **config.kwargs).use_fast_seeds()
            return
        except NotImplementedError:
            pass
    raise ConfigError(f"training.seeds: {config.entry_point} has no fast seeds, expected stock. {choice.reason}")


def _if_supported(entry_point: str, config: EnvironmentConfig) -> Implementation:
    vector_class = import_entry_point("environment.vector", entry_point, config.folder)
    if not (isinstance(vector_class, type) and issubclass(vector_class, VectorEnv)):
        raise ConfigError(f"environment.vector: {entry_point} is not a subclass of VectorEnv")
    make: Callable[..., VectorEnv] = vector_class
    try:
        make(1, **config.kwargs)
    except UnsupportedArguments as error:
        return _in_lockstep(f"of its arguments: {error}")
    except TypeError as error:
        raise ConfigError(f"environment.kwargs: {entry_point} does not accept them: {error}") from error
    return Implementation(make, f"It is vectorised by {entry_point}.")
