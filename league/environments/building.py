"""Builds environments (AEC, Parallel or MultiAgentEnv) from their configuration and describes their interface."""

import copy
import fnmatch
import logging
import os
import re
from collections.abc import Callable, Mapping
from contextlib import closing
from functools import cache
from inspect import signature
from itertools import chain
from typing import Any

from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import aec_to_parallel_wrapper
from pettingzoo.utils.wrappers import (
    AssertOutOfBoundsWrapper,
    OrderEnforcingWrapper,
    TerminateIllegalWrapper,
)

from league.conditions import declares_information, hides_information
from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.config.play import PlayConfig
from league.entry_points import import_entry_point, import_module, missing
from league.environments.apis import NAMES, api_of, with_api
from league.environments.declared import declared
from league.environments.names_and_masks import with_info_masks, with_names
from league.environments.patches import replace_pictures, replace_seeding, reset_all_state, set_render_mode
from league.environments.wrappers.wrapping import wrapped
from league.errors import ConfigError, EnvironmentMismatch, LeagueError, cause, no_exit
from league.interface import AgentInterface, Interface
from league.refs import check_slug
from league.spaces import Discrete, MultiDiscrete
from league.spaces.conversion import from_gymnasium, with_mask

logger = logging.getLogger(__name__)


class Cycle(aec_to_parallel_wrapper):
    """PettingZoo's AEC-to-Parallel conversion with one observation per agent and cycle.

    The original computes and discards an observation before each agent's step, which costs a third of the speed of
    pistonball and MPE.
    """

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], ...]:
        """Step all live agents in order, and report the results at the end of the cycle."""
        env = self.aec_env
        acting = env.agents[:]
        rewards = dict.fromkeys(acting, 0.0)
        for agent in acting:
            if env.agent_selection != agent:
                raise AssertionError(
                    f"it is the turn of {env.agent_selection}, expected {agent}: agents of a Parallel environment must"
                    " act in cycles and leave at the end of a cycle"
                )
            env.step(actions[agent])
            for other, reward in env.rewards.items():
                if other in rewards:
                    rewards[other] += reward
        terminations, truncations = dict(env.terminations), dict(env.truncations)
        infos = dict(env.infos)
        observations = {agent: env.observe(agent) for agent in env.agents}
        while env.agents and (env.terminations[env.agent_selection] or env.truncations[env.agent_selection]):
            env.step(None)
        self.agents = env.agents
        return observations, rewards, terminations, truncations, infos


def with_cycles(env: Any) -> Any:
    """Replace PettingZoo's conversion among the wrappers of `env` by `Cycle`."""
    if isinstance(env, aec_to_parallel_wrapper):
        return Cycle(env.aec_env)
    if isinstance(env, BaseParallelWrapper):
        env.env = with_cycles(env.env)
    return env


CHECKING_WRAPPERS = (OrderEnforcingWrapper, AssertOutOfBoundsWrapper, TerminateIllegalWrapper)
"""Removed, because they halve the speed of small games. Lockstep keeps the order and checks masks."""
PATCHES = (set_render_mode, reset_all_state, replace_seeding, replace_pictures)


def build(config: EnvironmentConfig, render_mode: str | None = None) -> Any:
    """Build an environment: a PettingZoo AECEnv or ParallelEnv, or an `RLlibEnv`. Its agents are strings.

    That of a game that runs in simulators has spaces only. The caller closes it. What `close` raises is logged and
    returned.

    Raises ConfigError if it cannot be imported, constructed or wrapped.
    """
    if config.external is not None:
        return declared(config.external)
    if render_mode != "human":
        # Lets environments draw without a display.
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    constructor = _constructor(config)
    # Copied, because some environments change their arguments.
    kwargs = copy.deepcopy(config.kwargs) | ({} if render_mode is None else {"render_mode": render_mode})
    try:
        with no_exit:
            env = constructor(**kwargs)
    except LeagueError:
        raise
    except Exception as error:
        if _refuses_arguments(constructor, kwargs, error):
            raise ConfigError(f"environment.kwargs: {config.entry_point} does not accept them: {error}") from error
        raise ConfigError(f"environment.entry_point: {config.entry_point} cannot be created{cause(error)}") from error
    api = api_of(env, config.api)
    if api is None or config.api not in (None, api):
        expected = NAMES[config.api] if config.api else "an environment of PettingZoo (AEC or Parallel) or RLlib"
        raise ConfigError(
            f"environment.entry_point: {config.entry_point} returned a {type(env).__name__}, expected {expected}"
        )
    env = with_names(with_api(_without_checks(env), api))
    try:
        for patch in PATCHES:
            patch(getattr(env, "unwrapped", env))
        if config.wrappers and api == "rllib":
            raise ConfigError(
                f"environment.wrappers: {config.wrappers[0].name} (number 1): SuperSuit supports only PettingZoo"
                " environments; for an RLlib environment, transform observations in its own code"
            )
        env = with_cycles(wrapped(env, config.wrappers))
        return with_safe_close(with_info_masks(env, f"{config.model_dump_json()}{config.folder}"))
    except BaseException:
        with_safe_close(env).close()
        raise


def with_safe_close(env: Any) -> Any:
    """Let `close` log and return an exception instead of raising it: it must neither hide an earlier error, nor keep
    other environments open, nor end the process. Returns `env`.
    """
    close = env.close

    def safe_close() -> Exception | None:
        try:
            with no_exit:
                close()
        except Exception as error:
            _log_once(f"The environment's close raised an exception{cause(error)}")
            return error
        return None

    env.close = safe_close
    return env


@cache
def _log_once(text: str) -> None:
    """Log a warning that is the same for all copies of an environment."""
    logger.warning(text)


def _refuses_arguments(constructor: Callable[..., Any], kwargs: Mapping[str, Any], error: Exception) -> bool:
    """Whether an error is about the names of arguments, which a constructor may pass on to another one."""
    try:
        signature(constructor).bind(**kwargs)
    except TypeError:
        return True
    except ValueError:  # it has no signature
        return isinstance(error, TypeError)
    return isinstance(error, TypeError) and "keyword argument" in str(error)


def _spaces(env: Any, agent: str, entry_point: str) -> AgentInterface:
    try:
        with no_exit:
            return agent_interface(env, agent)
    except LeagueError:
        raise
    except Exception as error:
        raise EnvironmentMismatch(f"{entry_point}: the spaces of {agent} cannot be read{cause(error)}") from error


def agent_interface(env: Any, agent: str) -> AgentInterface:
    """Return the spaces of an agent of a built environment. Raises EnvironmentMismatch if they are not supported."""
    spaces = env.observation_space(agent), env.action_space(agent)
    try:
        observation, action = map(from_gymnasium, spaces)
        return AgentInterface(observation=with_mask(observation, action), action=action)
    except EnvironmentMismatch as error:
        raise EnvironmentMismatch(f"agent {agent}: {error}") from error


def interface(config: LeagueConfig) -> Interface:
    """Build the league's environment and describe it. Raises ConfigError if policies or sides do not fit it."""
    with closing(build(config.environment)) as env:
        return describe(env, config)


def describe(env: Any, config: LeagueConfig) -> Interface:
    """Return the agents of `env` with their spaces, policies and sides."""
    names = list(getattr(env, "possible_agents", None) or ())
    if not names:
        raise EnvironmentMismatch(f"{config.environment.entry_point} has no possible_agents, which are required")
    agents = {agent: _spaces(env, agent, config.environment.entry_point) for agent in names}
    divided = config.policies
    if divided is None:
        policies = policies_by_spaces(agents)
    elif isinstance(divided, str):
        policies = _policies_from_function(divided, names, config.folder)
    else:
        policies = divide("policies", divided, names)
    sides = config.sides or {agent: (agent,) for agent in names}
    side_of = divide("sides", sides, names)
    first: dict[str, str] = {}
    for agent, policy in policies.items():
        other = first.setdefault(policy, agent)
        if agents[agent] != agents[other]:
            raise ConfigError(
                f"policies.{policy}: {other} and {agent} have different spaces: assign them separate policies,"
                " or pad the spaces with SuperSuit"
            )
    _check_action_names(config.play, agents, policies)
    return Interface(
        agents=agents,
        policies=policies,
        sides={side: tuple(agent for agent in names if side_of[agent] == side) for side in sides},
        hidden_information=hides_information(env),
        simultaneous=isinstance(env, ParallelEnv)
        and not declares_information(env)
        and len(sides) > 1
        and all(isinstance(spaces.action, Discrete | MultiDiscrete) for spaces in agents.values()),
    )


def _constructor(config: EnvironmentConfig) -> Any:
    module_name, colon, function = config.resolved_entry_point.partition(":")
    module = import_module("environment.entry_point", module_name, config.folder)
    if colon:
        name = function
    elif config.api == "aec" or (config.api is None and not hasattr(module, "parallel_env")):
        name = "env"
    else:
        name = "parallel_env"
    if not callable(getattr(module, name, None)):
        if colon:
            raise ConfigError(f"environment.entry_point: {missing(module, name)}")
        expected = "a PettingZoo module with it, or package.module:function"
        raise ConfigError(f"environment.entry_point: {module_name!r} has no {name!r}: expected {expected}")
    return getattr(module, name)


def _without_checks(env: Any) -> Any:
    while isinstance(env, CHECKING_WRAPPERS):
        env = env.env
    if isinstance(env, aec_to_parallel_wrapper):
        env.aec_env = _without_checks(env.aec_env)
    return env


def _policies_from_function(entry_point: str, agents: list[str], folder: str | None) -> dict[str, str]:
    """Return agent → policy id, as defined by the user's function."""
    function = import_entry_point("policies", entry_point, folder)
    if not callable(function):
        raise ConfigError(f"policies: {entry_point} is not a function")
    mapped = {}
    for agent in agents:
        try:
            with no_exit:
                mapped[agent] = check_slug("policy", function(agent))
        except Exception as error:
            raise ConfigError(
                f"policies: {entry_point} returned no valid policy id for agent {agent!r}: {error}"
            ) from error
    return mapped


def policies_by_spaces(agents: Mapping[str, AgentInterface]) -> dict[str, str]:
    """Return agent → policy id, with one policy for each kind of agents with equal spaces.

    A single policy is `shared`. Several have the name of their first agents without its number (`adversary` for
    `adversary_0`), or with it where kinds have equal names.
    """
    kinds: list[list[str]] = []
    for agent, spaces in agents.items():
        kind = next((kind for kind in kinds if agents[kind[0]] == spaces), None)
        if kind is None:
            kinds.append([agent])
        else:
            kind.append(agent)
    if len(kinds) == 1:
        return dict.fromkeys(agents, "shared")
    firsts = [re.sub(r"[^a-z0-9_-]", "_", kind[0].lower()) for kind in kinds]
    stems = [re.sub(r"_?\d+$", "", first) for first in firsts]
    names = [
        stem if _is_slug(stem) and stems.count(stem) == 1 else first for first, stem in zip(firsts, stems, strict=True)
    ]
    if len(set(names)) < len(names) or not all(map(_is_slug, names)):
        names = [f"kind_{number}" for number in range(len(kinds))]
    name_of = {agent: name for name, kind in zip(names, kinds, strict=True) for agent in kind}
    return {agent: name_of[agent] for agent in agents}


def describe_policies(interface: Interface) -> str:
    """Return a human-readable sentence: the policies with their agents."""
    parts = []
    for policy in interface.policy_ids:
        policy_agents = [agent for agent in interface.agents if interface.policies[agent] == policy]
        agents = (
            ", ".join(policy_agents)
            if len(policy_agents) <= 3
            else f"{policy_agents[0]} and {len(policy_agents) - 1} more"
        )
        parts.append(f"{policy} ({agents})")
    return f"{'Policy' if len(parts) == 1 else 'Policies'}: {', '.join(parts)}."


def _is_slug(name: str) -> bool:
    try:
        check_slug("policy", name)
    except LeagueError:
        return False
    return True


def divide(key: str, groups: dict[str, tuple[str, ...]], agents: list[str]) -> dict[str, str]:
    """Return agent → the group that names it, else the first group with a matching pattern."""
    of_agent = {}
    for agent in agents:
        # As a pattern, a name such as drone[3] matches another agent.
        naming = (group for group, patterns in groups.items() if agent in patterns)
        fitting = (
            group
            for group, patterns in groups.items()
            if any(fnmatch.fnmatchcase(agent, pattern) for pattern in patterns)
        )
        if (group := next(chain(naming, fitting), None)) is None:
            raise ConfigError(f"{key}: agent {agent!r} matches none of {', '.join(groups)}")
        of_agent[agent] = group
    for group in groups:
        if group not in of_agent.values():
            raise ConfigError(f"{key}.{group}: matches no agent, expected some of {', '.join(agents)}")
    return of_agent


def _check_action_names(play: PlayConfig, agents: dict[str, AgentInterface], policies: dict[str, str]) -> None:
    """Names given per policy must fit its actions; names given for all policies must fit all Discrete ones."""
    actions = {policy: agents[agent].action for agent, policy in policies.items()}
    for policy in play.action_names if isinstance(play.action_names, dict) else ():
        if not isinstance(actions.get(policy), Discrete):
            policy_ids = ", ".join(name for name, space in actions.items() if isinstance(space, Discrete))
            raise ConfigError(
                f"play.action_names.{policy}: expected a policy with Discrete actions ({policy_ids or 'there is none'})"
            )
    if play.action_names and not any(isinstance(space, Discrete) for space in actions.values()):
        raise ConfigError("play.action_names: no policy has Discrete actions: remove the names")
    for policy, space in actions.items():
        names = play.names_for(policy)
        if isinstance(space, Discrete) and names and len(names) != space.n:
            raise ConfigError(f"play.action_names: policy {policy} has {space.n} actions, but {len(names)} names")
