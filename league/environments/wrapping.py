"""SuperSuit's wrappers by name and arguments, in the order of the league's config. The only SuperSuit stack."""

import importlib
import re
import warnings
from collections.abc import Sequence
from typing import Any

import supersuit
from pettingzoo import AECEnv, ParallelEnv
from supersuit.lambda_wrappers.reward_lambda import aec_reward_lambda

from league.config import WrapperConfig
from league.environments.batched_wrappers import batched
from league.errors import ConfigError

VECTORS = re.compile(r"vec_env|vectorize|concat_vec")


def wrapped(env: AECEnv | ParallelEnv, wrappers: Sequence[WrapperConfig]) -> AECEnv | ParallelEnv:
    """`env` with `wrappers`, the first of them innermost.

    Raises ConfigError, naming the wrapper and its place, for one that SuperSuit has not, that does not take its
    arguments, or that cannot stand on what is before it.
    """
    if not wrappers:
        return env
    bare, spaces = env, [_observed(env)]
    for position, wrapper in enumerate(wrappers, start=1):
        env = _stock(env, wrapper, position)
        spaces.append(_observed(env))
    fast = (
        batched(bare, [_with_arguments(each) for each in wrappers], spaces) if isinstance(bare, ParallelEnv) else None
    )
    return env if fast is None else fast


def _observed(env: AECEnv | ParallelEnv) -> list[Any]:
    return [env.observation_space(agent) for agent in env.possible_agents]


def _stock(env: AECEnv | ParallelEnv, wrapper: WrapperConfig, position: int) -> AECEnv | ParallelEnv:
    where = f"environment.wrappers: {wrapper.name} (number {position})"
    make = _maker(wrapper.name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = make(env, **_with_arguments(wrapper).kwargs)
            for agent in made.possible_agents:
                # Some check what they stand on only when they are asked.
                made.observation_space(agent)
                made.action_space(agent)
    except (TypeError, AssertionError, ValueError, AttributeError, IndexError, KeyError, NotImplementedError) as error:
        agent = env.possible_agents[0]
        given = f"before it, {agent} observes {env.observation_space(agent)} and acts {env.action_space(agent)}"
        raise ConfigError(f"{where}: {' '.join(str(error).split()) or type(error).__name__}; {given}") from error
    return _with_whole_reset(made) if isinstance(made, aec_reward_lambda) else made


def _with_whole_reset(env: AECEnv) -> AECEnv:
    """SuperSuit's wrapper of rewards without what is left of the episode before: its reset keeps the sums."""
    stock = env.reset

    def reset(seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        vars(env).pop("_cumulative_rewards", None)
        stock(seed=seed, options=options)

    env.reset = reset
    return env


def _maker(name: str) -> Any:
    if VECTORS.search(name):
        raise ConfigError(
            f"environment.wrappers: {name} makes a vector of environments, which a league does itself: leave it out"
        )
    try:
        make = getattr(supersuit, name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"environment.wrappers: SuperSuit has no wrapper {name!r}: {error}") from error
    if not (callable(make) and re.search(r"_v\d+$", name)):
        raise ConfigError(
            f"environment.wrappers: SuperSuit's {name!r} is no wrapper: expected one such as frame_stack_v1"
        )
    return make


def _with_arguments(wrapper: WrapperConfig) -> WrapperConfig:
    """The same wrapper with its arguments as SuperSuit takes them: YAML has neither tuples nor functions."""
    return WrapperConfig(name=wrapper.name, kwargs={key: _argument(wrapper, key) for key in wrapper.kwargs})


def _argument(wrapper: WrapperConfig, key: str) -> Any:
    value = wrapper.kwargs[key]
    if isinstance(value, list):
        return tuple(value)
    if not (key.endswith("_fn") and isinstance(value, str)):
        return value
    module_name, _, name = value.partition(":")
    try:
        return getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f"environment.wrappers: {wrapper.name}.{key}: {value!r} is no function package.module:function: {error}"
        ) from error
