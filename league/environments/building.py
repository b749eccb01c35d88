"""Environment configuration → environment, with the league's SuperSuit wrappers."""

import fnmatch
import importlib
import os
from typing import Any

import gymnasium
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel_wrapper
from pettingzoo.utils.wrappers import (
    AssertOutOfBoundsWrapper,
    OrderEnforcingWrapper,
    TerminateIllegalWrapper,
)

from league.config import EnvironmentConfig, LeagueConfig
from league.environments.cards import with_reseeding
from league.environments.cycles import with_cycles
from league.environments.drawing import with_drawing
from league.environments.knights import with_whole_reset
from league.environments.pistonball import with_one_copy
from league.environments.wrapping import wrapped
from league.errors import ConfigError, EnvironmentMismatch
from league.interface import AgentInterface, Interface
from league.refs import check_slug
from league.spaces import from_gymnasium

CHECKING_WRAPPERS = (OrderEnforcingWrapper, AssertOutOfBoundsWrapper, TerminateIllegalWrapper)
"""They guard a careless caller at half of a small game's speed. Stepping keeps the order and checks masks itself."""
AMENDMENTS = (with_drawing, with_whole_reset, with_reseeding, with_one_copy)
"""What is amiss or wasteful in some of PettingZoo's own environments, put right."""
NAMES = {"aec": "a PettingZoo AECEnv", "parallel": "a PettingZoo ParallelEnv", "rllib": "an RLlib MultiAgentEnv"}


def build(config: EnvironmentConfig, render_mode: str | None = None) -> Any:
    """Make the environment that `config` describes: a PettingZoo AECEnv or ParallelEnv, or an RLlib MultiAgentEnv.

    Raises ConfigError for what cannot be imported, constructed or wrapped.
    """
    if render_mode != "human":
        # Environments that draw on a screen need none.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    constructor = _constructor(config)
    kwargs = config.kwargs if render_mode is None else config.kwargs | {"render_mode": render_mode}
    try:
        env = constructor(**kwargs)
    except TypeError as error:
        raise ConfigError(f"environment.kwargs: {config.entry_point} does not take them: {error}") from error
    found = _api(env)
    if found is None or config.api not in (None, found):
        expected = NAMES[config.api] if config.api else "an environment of PettingZoo (AEC or Parallel) or RLlib"
        raise ConfigError(
            f"environment.entry_point: {config.entry_point} made a {type(env).__name__}, expected {expected}"
        )
    env = _unchecked(env)
    for amend in AMENDMENTS:
        env = amend(env)
    if config.wrappers and found == "rllib":
        raise ConfigError(
            f"environment.wrappers: {config.wrappers[0].name} (number 1): SuperSuit wraps PettingZoo environments only,"
            " and this one is RLlib's: change what it observes in its own code"
        )
    return with_cycles(wrapped(env, config.wrappers))


def observation_space(env: Any, agent: str) -> gymnasium.Space[Any]:
    """What `agent` observes, by any API."""
    if isinstance(env, AECEnv | ParallelEnv):
        return env.observation_space(agent)
    return _rllib_space(env, "observation_space", agent)


def action_space(env: Any, agent: str) -> gymnasium.Space[Any]:
    """How `agent` acts, by any API."""
    return (
        env.action_space(agent) if isinstance(env, AECEnv | ParallelEnv) else _rllib_space(env, "action_space", agent)
    )


def _rllib_space(env: Any, name: str, agent: str) -> gymnasium.Space[Any]:
    """A MultiAgentEnv has a dictionary of spaces, or one space for all: a Dict by agent, or what each has alike."""
    spaces = getattr(env, f"{name}s", None)
    if spaces and agent in spaces:
        return spaces[agent]
    space = getattr(env, name, None)
    if isinstance(space, gymnasium.spaces.Dict) and agent in space.spaces:
        return space.spaces[agent]
    if not spaces and isinstance(space, gymnasium.Space):
        return space
    raise EnvironmentMismatch(f"{type(env).__name__} has no {name} for agent {agent!r}: expected one in `{name}s`")


def interface(config: LeagueConfig) -> Interface:
    """Build the league's environment once and describe it. Raises ConfigError where policies or sides do not fit it."""
    env = build(config.environment)
    try:
        return describe(env, config)
    finally:
        env.close()


def describe(env: Any, config: LeagueConfig) -> Interface:
    """The agents of `env` with their spaces, divided into policies and sides as `config` says."""
    names = list(getattr(env, "possible_agents", None) or ())
    if not names:
        raise EnvironmentMismatch(f"{config.environment.entry_point} has no possible_agents, which a league needs")
    if not all(isinstance(name, str) for name in names):
        raise EnvironmentMismatch(f"{config.environment.entry_point} has agents {names}: expected names, not numbers")
    agents = {
        agent: AgentInterface(
            observation=from_gymnasium(observation_space(env, agent)),
            action=from_gymnasium(action_space(env, agent)),
        )
        for agent in names
    }
    divided = config.policies
    policies = _mapped(divided, names) if isinstance(divided, str) else divide("policies", divided, names)
    sides = config.sides or {agent: (agent,) for agent in names}
    side_of = divide("sides", sides, names)
    _same_spaces(agents, policies)
    return Interface(
        agents=agents,
        policies=policies,
        sides={side: tuple(agent for agent in names if side_of[agent] == side) for side in sides},
    )


def _constructor(config: EnvironmentConfig) -> Any:
    module_name, colon, function = config.entry_point.partition(":")
    module = _imported("environment.entry_point", module_name)
    if colon:
        name = function
    elif config.api == "aec" or (config.api is None and not hasattr(module, "parallel_env")):
        name = "env"
    else:
        name = "parallel_env"
    if not callable(getattr(module, name, None)):
        expected = "a function of that name" if colon else "a PettingZoo module with it, or package.module:function"
        raise ConfigError(f"environment.entry_point: {module_name!r} has no {name!r}: expected {expected}")
    return getattr(module, name)


def _imported(key: str, name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(f"{key}: cannot import {name!r}: {error}") from error
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{key}: {name!r} names no module") from error


def _api(env: Any) -> str | None:
    if isinstance(env, AECEnv):
        return "aec"
    if isinstance(env, ParallelEnv):
        return "parallel"
    is_rllib = all(hasattr(env, name) for name in ("reset", "step", "possible_agents"))
    return "rllib" if is_rllib else None


def _unchecked(env: Any) -> Any:
    while isinstance(env, CHECKING_WRAPPERS):
        env = env.env
    if isinstance(env, aec_to_parallel_wrapper):
        env.aec_env = _unchecked(env.aec_env)
    return env


def _mapped(entry_point: str, agents: list[str]) -> dict[str, str]:
    """agent → policy id, as the user's function says."""
    module_name, _, name = entry_point.partition(":")
    function = getattr(_imported("policies", module_name), name, None)
    if not callable(function):
        raise ConfigError(f"policies: {module_name!r} has no function {name!r}")
    mapped = {}
    for agent in agents:
        try:
            mapped[agent] = check_slug("policy", function(agent))
        except Exception as error:
            raise ConfigError(f"policies: {entry_point} gives no policy for agent {agent!r}: {error}") from error
    return mapped


def divide(key: str, groups: dict[str, tuple[str, ...]], agents: list[str]) -> dict[str, str]:
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
