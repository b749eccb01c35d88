"""Checks environments (`league check-env`): spaces, seeding, masks, rewards, global state and PettingZoo's API tests.

Episodes are played with random legal actions. A *fault* leads to wrong results or failing runs; a *note* is a warning.
"""

import contextlib
import io
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.test import api_test, parallel_api_test

from league.conditions import describe_selection
from league.config.environment import EnvironmentConfig
from league.config.league import LeagueConfig
from league.environments.building import build, describe, describe_policies
from league.environments.conformance.episodes import Examiner
from league.environments.conformance.findings import Examination, Vectorised
from league.environments.conformance.time_budget import TimeBudget
from league.environments.equality import compare
from league.environments.implementation import implementation
from league.environments.vector.measurement import steps_per_second
from league.errors import InvalidReturn, LeagueError, cause, no_exit, one_line, raised_at
from league.interface import Interface
from league.spaces import Box, Discrete, MultiDiscrete

T = TypeVar("T")

CYCLES = 50
"""Number of cycles of PettingZoo's API tests."""
BARE_SECONDS = 10.0
"""Maximum duration of the search for a wrong return below wrappers."""
COMPARED_COPIES, COMPARED_STEPS = 32, 20_000
"""Size of the comparison of a vectorised environment with its stock environment."""
MEASURED_COPIES, MEASURED_SECONDS = 1024, 1.0
"""Copies and duration of the measurement of its speed."""


def examine(
    config: LeagueConfig,
    episodes: int = 3,
    steps: int | None = None,
    seed: int = 0,
    *,
    seconds: float | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Examination:
    """Play and check episodes with random legal actions. Never raises exceptions of the environment.

    Args:
        config: The league.
        episodes: Number of episodes, each played several times.
        steps: Maximum number of steps per episode. None: an episode that has not ended after `play.max_moves` steps is
            a fault.
        seed: Seed of the first episode.
        seconds: Time after which the checks are cut short, which a note says. None: they take as long as they need.
        progress: Receives what is done, at each step.

    Returns:
        The findings, with the lengths of the episodes, the speed and the effect of random openings.
    """
    examination, budget = Examination(), TimeBudget(seconds, progress)
    consequence = f"{config.environment.entry_point} cannot be created"
    reason = _attempt(lambda: implementation(config.environment).reason, examination, consequence)
    if reason is None:
        return examination
    examination.implementation = reason
    if (env := _attempt(lambda: build(config.environment), examination, consequence)) is None:
        return examination
    try:
        interface = _described(env, config, examination)
        if interface is not None and config.environment.external is None:
            examiner = Examiner(env, interface, config, examination, budget)
            try:
                with no_exit:
                    examiner.examine(episodes, seed, steps)
            except Exception as error:
                examination.add("fault", _explained(error, config, seed, examiner.recording.place))
    finally:
        error_of_close = env.close()
    if error_of_close is not None:
        fault = "`close` raised an exception, and may leave behind what the environment has started"
        examination.add("note", f"{fault}{cause(error_of_close)}")
    if interface is None or config.environment.external is not None:
        return examination
    if examination.passed:
        _run_pettingzoo_tests(config.environment, examination, budget)
    if examination.passed:
        _compare_vectorised(config.environment, interface, examination, seed)
    if budget.skipped:
        examination.add(
            "note",
            f"the checks were cut short after {seconds:.0f} s, because the environment takes"
            f" {1 / examination.steps_per_second:.2g} s per step: {', '.join(budget.skipped)} (--seconds)",
        )
    return examination


def _attempt(call: Callable[[], T], examination: Examination, consequence: str) -> T | None:
    """Return the result of a call. What it raises is recorded as a fault; an exception of a user's code follows
    `consequence`.
    """
    try:
        with no_exit:
            return call()
    except LeagueError as error:
        examination.add("fault", str(error))
    except Exception as error:
        examination.add("fault", f"{consequence}{cause(error)}")
    return None


def _described(env: Any, config: LeagueConfig, examination: Examination) -> Interface | None:
    """Record the interface of an environment. Returns it if episodes can be played, else None."""
    consequence = f"{config.environment.entry_point} cannot be described"
    if (interface := _attempt(lambda: describe(env, config), examination, consequence)) is None:
        return None
    examination.api = (
        "AEC" if isinstance(env, AECEnv) else "Parallel" if isinstance(env, ParallelEnv) else "MultiAgentEnv"
    )
    examination.agents = len(interface.agents)
    examination.policies = describe_policies(interface)
    examination.actions = describe_selection(config, interface)
    for agent, spaces in interface.agents.items():
        action = spaces.action
        is_float_box = isinstance(action, Box) and np.dtype(action.dtype).kind == "f"
        if not (is_float_box or isinstance(action, Discrete | MultiDiscrete)):
            examination.add(
                "fault", "has an unsupported action space: expected Discrete, MultiDiscrete or a Box of floats", agent
            )
    examination.interface = interface
    return interface if examination.passed else None


def _explained(error: Exception, config: LeagueConfig, seed: int, place: str) -> str:
    """The fault that an exception shows. A wrapper's own exception does not say what it was given."""
    if isinstance(error, InvalidReturn):
        return f"{error} ({place})"
    if isinstance(error, LeagueError):
        return str(error)
    if config.environment.wrappers:
        bare = config.model_copy(update={"environment": config.environment.model_copy(update={"wrappers": ()})})
        with contextlib.suppress(Exception):
            try:
                with no_exit, contextlib.closing(build(bare.environment)) as env:
                    budget = TimeBudget(BARE_SECONDS)
                    Examiner(env, describe(env, bare), bare, Examination(), budget).examine(1, seed, None)
            except InvalidReturn as returned:
                return f"{returned} (below its wrappers, {place})"
    where = "".join(f"{line}, " for line in [raised_at(error)] if line)
    return f"the environment raised an exception ({where}{place}): {one_line(error, with_type=True)}"


def _compare_vectorised(config: EnvironmentConfig, interface: Interface, examination: Examination, seed: int) -> None:
    """Compare the vectorised environment, if there is one, with the stock one."""
    vector = implementation(config).vector
    if vector is None:
        return
    try:
        with no_exit:
            comparison = compare(config, vector(COMPARED_COPIES, **config.kwargs), COMPARED_STEPS, seed)
            if comparison.difference is not None:
                examination.add("fault", f"the vectorised environment differs: {comparison.difference}")
                return
            actions = [spaces.action for spaces in interface.agents.values()]
            rate = steps_per_second(vector(MEASURED_COPIES, **config.kwargs), actions, seed, MEASURED_SECONDS)
    except Exception as error:
        examination.add("fault", f"the vectorised environment raised an exception: {one_line(error, with_type=True)}")
        return
    examination.vectorised = Vectorised(comparison.steps, MEASURED_COPIES, rate, comparison.stock_rate)


def _run_pettingzoo_tests(config: EnvironmentConfig, examination: Examination, budget: TimeBudget) -> None:
    """Run PettingZoo's API tests. They check more than is required here, so failures are notes."""
    steps = CYCLES * (examination.agents if examination.api == "AEC" else 1)
    if examination.api == "MultiAgentEnv" or not examination.steps_per_second:
        return
    if budget.is_spent(ahead=steps / examination.steps_per_second):
        budget.skipped.append("PettingZoo's API test was not run")
        return
    budget.report("PettingZoo's API test")
    with contextlib.closing(build(config)) as env:
        try:
            with no_exit, warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                if isinstance(env, AECEnv):
                    api_test(env, num_cycles=CYCLES)
                else:
                    parallel_api_test(env, num_cycles=CYCLES)
        except Exception as error:
            examination.add("note", f"PettingZoo's API test fails: {one_line(error, with_type=True)}")
