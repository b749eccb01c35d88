"""Applies wrappers: those of SuperSuit by name, vectorised over agents where possible, and those of the user's code."""

import difflib
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import supersuit
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from supersuit.lambda_wrappers.reward_lambda import aec_reward_lambda

from league.config.environment import WrapperConfig
from league.entry_points import import_entry_point
from league.environments.wrappers.transforms import Transform, UnsupportedWrapper, channel, transform
from league.errors import ConfigError, cause, no_exit, one_line


class BatchedWrappers(BaseParallelWrapper):
    """Replaces a sequence of wrappers by transforms of all agents' observations, with identical results."""

    def __init__(
        self,
        env: ParallelEnv,
        view: Callable[[NDArray], NDArray] | None,
        transforms: Sequence[Transform],
        observed: Sequence[spaces.Space[Any]],
    ) -> None:
        """view: applied to each observation before stacking, None for the identity. observed: resulting spaces."""
        super().__init__(env)
        self._index = {agent: index for index, agent in enumerate(env.possible_agents)}
        self._view, self._transforms, self._observed = view, transforms, observed

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._observed[self._index[agent]]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        observations, infos = self.env.reset(seed=seed, options=options)
        for observation_transform in self._transforms:
            observation_transform.reset(np.arange(len(self._index)))
        return self._transformed(observations), infos

    def step(self, actions: dict[str, Any]) -> tuple[dict[str, Any], Any, Any, Any, Any]:
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        return self._transformed(observations), rewards, terminated, truncated, infos

    def _transformed(self, observations: Mapping[str, NDArray]) -> dict[str, NDArray]:
        if not observations:
            return {}
        agents = np.array([self._index[agent] for agent in observations])
        values = observations.values() if self._view is None else map(self._view, observations.values())
        rows = np.array(list(values))
        for observation_transform in self._transforms:
            rows = observation_transform(rows, agents)
        return dict(zip(observations, rows, strict=True))


def batched(
    env: ParallelEnv, wrappers: Sequence[WrapperConfig], spaces_before: Sequence[Sequence[spaces.Space[Any]]]
) -> ParallelEnv | None:
    """Return `env` with vectorised wrappers; None if a wrapper or a space is not supported.

    spaces_before[i]: the agents' observation spaces before wrapper i, as reported by SuperSuit; the last entry is the
    result of all wrappers.
    """
    if any(space != before[0] for before in spaces_before[:-1] for space in before):
        return None
    firsts = [before[0] for before in spaces_before]
    try:
        transforms = [
            transform(wrapper, space, changed, env.possible_agents)
            for wrapper, space, changed in zip(wrappers, firsts[:-1], firsts[1:], strict=True)
        ]
    except UnsupportedWrapper:
        return None
    view = channel(**wrappers[0].kwargs) if wrappers[0].name == "color_reduction_v0" else None
    return BatchedWrappers(env, view, transforms[view is not None :], spaces_before[-1])


VECTORS = re.compile(r"vec_env|vectorize|concat_vec")


def wrapped(env: AECEnv | ParallelEnv, wrappers: Sequence[WrapperConfig]) -> AECEnv | ParallelEnv:
    """Apply wrappers to `env`, the first one innermost.

    Raises ConfigError, with name and position of the wrapper, if it does not exist, or does not support its arguments
    or the spaces before it.
    """
    if not wrappers:
        return env
    stages = _stages(env, wrappers)
    observed = [AgentSpaces.of(stage).observations for stage in stages]
    fast = (
        batched(env, [with_arguments(wrapper) for wrapper in wrappers], observed)
        if isinstance(env, ParallelEnv)
        else None
    )
    return stages[-1] if fast is None else fast


@dataclass(frozen=True, slots=True)
class AgentSpaces:
    """The spaces of all agents."""

    observations: list[spaces.Space[Any]]
    actions: list[spaces.Space[Any]]

    @classmethod
    def of(cls, env: AECEnv | ParallelEnv) -> "AgentSpaces":
        """Return the spaces of an environment."""
        agents = env.possible_agents
        return cls([env.observation_space(agent) for agent in agents], [env.action_space(agent) for agent in agents])


def agent_spaces(env: AECEnv | ParallelEnv, wrappers: Sequence[WrapperConfig]) -> list[AgentSpaces]:
    """Return the spaces before each wrapper and after the last. Raises what `wrapped` raises."""
    return [AgentSpaces.of(stage) for stage in _stages(env, wrappers)]


def _stages(env: AECEnv | ParallelEnv, wrappers: Sequence[WrapperConfig]) -> list[AECEnv | ParallelEnv]:
    """Return `env` without wrappers, with the first, with the first two, …"""
    stages = [env]
    for position, wrapper in enumerate(wrappers, start=1):
        stages.append(_stock(stages[-1], wrapper, position))
    return stages


def _stock(env: AECEnv | ParallelEnv, wrapper: WrapperConfig, position: int) -> AECEnv | ParallelEnv:
    where = f"environment.wrappers: {wrapper.name} (number {position})"
    if wrapper.is_own:
        return _own(env, wrapper, where)
    make = _maker(wrapper.name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            made = make(env, **with_arguments(wrapper).kwargs)
            for agent in made.possible_agents:
                # Some wrappers check the space only on access.
                made.observation_space(agent)
                made.action_space(agent)
    except (TypeError, AssertionError, ValueError, AttributeError, IndexError, KeyError, NotImplementedError) as error:
        agent = env.possible_agents[0]
        context = (
            f"before it, {agent} has observations {env.observation_space(agent)} and actions {env.action_space(agent)}"
        )
        raise ConfigError(f"{where}: {one_line(error)}; {context}") from error
    if isinstance(made, aec_reward_lambda):
        stock = made.reset

        def reset(seed: int | None = None, options: dict[str, Any] | None = None) -> None:
            # SuperSuit's reward wrapper keeps them from the previous episode.
            vars(made).pop("_cumulative_rewards", None)
            stock(seed=seed, options=options)

        made.reset = reset
    return made


def _own(env: AECEnv | ParallelEnv, wrapper: WrapperConfig, where: str) -> AECEnv | ParallelEnv:
    api = AECEnv if isinstance(env, AECEnv) else ParallelEnv
    try:
        with no_exit:
            made = import_entry_point(where, wrapper.name)(env, **wrapper.kwargs)
    except ConfigError:
        raise
    except Exception as error:
        raise ConfigError(f"{where} cannot be created{cause(error)}") from error
    if not isinstance(made, api):
        raise ConfigError(f"{where} returned a {type(made).__name__}, expected an {api.__name__} as the environment is")
    return made


def _maker(name: str) -> Any:
    if VECTORS.search(name):
        raise ConfigError(
            f"environment.wrappers: {name} creates a vector environment, which is not needed here: remove it"
        )
    try:
        make = getattr(supersuit, name)
    except (ImportError, AttributeError) as error:
        wrapper_names = [wrapper for wrapper in dir(supersuit) if re.search(r"_v\d+$", wrapper)]
        near = difflib.get_close_matches(name, wrapper_names, n=1)
        # The error of a former version of a wrapper names the present one.
        hint = f"did you mean {near[0]!r}?" if near and type(error) is ImportError else error
        raise ConfigError(f"environment.wrappers: SuperSuit has no wrapper {name!r}: {hint}") from error
    if not (callable(make) and re.search(r"_v\d+$", name)):
        raise ConfigError(
            f"environment.wrappers: {name!r} of SuperSuit is not a wrapper: expected for example frame_stack_v1"
        )
    return make


def with_arguments(wrapper: WrapperConfig) -> WrapperConfig:
    """Convert arguments from YAML: lists to tuples, and names of functions to functions."""
    kwargs = {key: tuple(value) if isinstance(value, list) else value for key, value in wrapper.kwargs.items()}
    for key, value in kwargs.items():
        if key.endswith("_fn") and isinstance(value, str):
            kwargs[key] = import_entry_point(f"environment.wrappers: {wrapper.name}.{key}", value)
    return WrapperConfig(name=wrapper.name, kwargs=kwargs)
