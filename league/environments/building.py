"""Environment configuration → PettingZoo AEC environment, with the league's SuperSuit wrappers."""

import fnmatch
import importlib
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.wrappers import (
    AssertOutOfBoundsWrapper,
    OrderEnforcingWrapper,
    TerminateIllegalWrapper,
)

from league.config import EnvironmentConfig, LeagueConfig, WrapperConfig
from league.errors import ConfigError, EnvironmentMismatch
from league.interface import AgentInterface, Interface
from league.spaces import from_gymnasium

CHECKING_WRAPPERS = (OrderEnforcingWrapper, AssertOutOfBoundsWrapper, TerminateIllegalWrapper)
"""They guard a careless caller at half of a small game's speed. Stepping keeps the order and checks masks itself."""


def build(config: EnvironmentConfig, render_mode: str | None = None) -> AECEnv:
    """Make the environment that `config` describes. Raises ConfigError for what cannot be imported or constructed."""
    constructor = _constructor(config.entry_point)
    kwargs = config.kwargs if render_mode is None else config.kwargs | {"render_mode": render_mode}
    try:
        env = constructor(**kwargs)
    except TypeError as error:
        raise ConfigError(f"environment.kwargs: {config.entry_point} does not take them: {error}") from error
    if not isinstance(env, AECEnv):
        raise ConfigError(
            f"environment.entry_point: {config.entry_point} made a {type(env).__name__}, expected a PettingZoo AECEnv"
        )
    env = _unchecked(env)
    for wrapper in config.wrappers:
        env = _wrapped(env, wrapper)
    return env


def interface(config: LeagueConfig) -> Interface:
    """Build the league's environment once and describe it. Raises ConfigError where policies or sides do not fit it."""
    env = build(config.environment)
    try:
        return describe(env, config)
    finally:
        env.close()


def describe(env: AECEnv, config: LeagueConfig) -> Interface:
    """The agents of `env` with their spaces, divided into policies and sides as `config` says."""
    try:
        names = list(env.possible_agents)
    except AttributeError as error:
        raise EnvironmentMismatch(
            f"{config.environment.entry_point} has no possible_agents, which a league needs"
        ) from error
    agents = {
        agent: AgentInterface(
            observation=from_gymnasium(env.observation_space(agent)),
            action=from_gymnasium(env.action_space(agent)),
        )
        for agent in names
    }
    policies = _divide("policies", config.policies, names)
    sides = config.sides or {agent: (agent,) for agent in names}
    side_of = _divide("sides", sides, names)
    _same_spaces(agents, policies)
    return Interface(
        agents=agents,
        policies=policies,
        sides={side: tuple(agent for agent in names if side_of[agent] == side) for side in sides},
    )


def _constructor(entry_point: str) -> Any:
    module_name, colon, function = entry_point.partition(":")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"environment.entry_point: cannot import {module_name!r}: {error}") from error
    except (ValueError, TypeError) as error:
        raise ConfigError(f"environment.entry_point: {entry_point!r} names no module") from error
    name = function if colon else "env"
    if not callable(getattr(module, name, None)):
        expected = "a function of that name" if colon else "a PettingZoo module with `env`, or package.module:function"
        raise ConfigError(f"environment.entry_point: {module_name!r} has no {name!r}: expected {expected}")
    return getattr(module, name)


def _unchecked(env: AECEnv) -> AECEnv:
    while isinstance(env, CHECKING_WRAPPERS):
        env = env.env
    return env


def _wrapped(env: AECEnv, wrapper: WrapperConfig) -> AECEnv:
    import supersuit

    try:
        make = getattr(supersuit, wrapper.name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"environment.wrappers: SuperSuit has no wrapper {wrapper.name!r}: {error}") from error
    try:
        wrapped = make(env, **wrapper.kwargs)
    except (TypeError, AssertionError, ValueError) as error:
        raise ConfigError(f"environment.wrappers: {wrapper.name}: {error}") from error
    return wrapped


def _divide(key: str, groups: dict[str, tuple[str, ...]], agents: list[str]) -> dict[str, str]:
    """agent → the first group one of whose patterns fits it."""
    of_agent = {}
    for agent in agents:
        fitting = [group for group, patterns in groups.items() if _fits(agent, patterns)]
        if not fitting:
            raise ConfigError(f"{key}: agent {agent!r} fits none of {', '.join(groups)}")
        of_agent[agent] = fitting[0]
    for group in groups:
        if group not in of_agent.values():
            raise ConfigError(f"{key}.{group}: fits no agent, expected some of {', '.join(agents)}")
    return of_agent


def _fits(agent: str, patterns: tuple[str, ...]) -> bool:
    return any(fnmatch.fnmatchcase(agent, pattern) for pattern in patterns)


def _same_spaces(agents: dict[str, AgentInterface], policies: dict[str, str]) -> None:
    first: dict[str, str] = {}
    for agent, policy in policies.items():
        other = first.setdefault(policy, agent)
        if agents[agent] != agents[other]:
            raise ConfigError(
                f"policies.{policy}: {other} and {agent} have different spaces: give them policies of their own,"
                " or pad the spaces with SuperSuit"
            )
