"""Calls policies and validates their actions row by row. Rows without a playable action forfeit their games.

The result of a row must not depend on its batch. If a policy fails on a batch, it is called for each row separately
with the row's random numbers restored, so that a fault in one game does not affect the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evaluation.matches.game_state import ActionNumbers, State
from league.environments.stepping import Batch, allows_nothing, legal_rows
from league.errors import IllegalMask, RemoteError, one_line, raised_at
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions, MalformedAction, Policy
from league.results.records import MAX_DETAIL, Reason
from league.search.policies import SearchPolicy
from league.spaces import ACTION_MASK, Box, Discrete, Leaf, MultiDiscrete

Generators = Sequence[np.random.Generator]
Randomness = Generators | ActionNumbers | None
"""The generators of scripts, the numbers with which graphs sample their actions, or None for greedy actions."""


@dataclass(frozen=True, slots=True)
class PolicyFault:
    """Why a row has no playable action. detail: as in a Forfeit."""

    reason: Reason
    detail: str


@dataclass(slots=True)
class PolicyOutput:
    """Actions (k, …) and recurrent states of k rows; states are None for a policy without.

    faults: by row. Actions and states of faulty rows are undefined.
    """

    actions: NDArray
    states: State | None
    faults: dict[int, PolicyFault] = field(default_factory=dict)


def call_policy(policy: Policy, batch: Batch, space: Leaf, state: State | None, randomness: Randomness) -> PolicyOutput:
    """Call a policy that acts in `space` on a batch.

    Raises IllegalMask if the environment allows no action, and RemoteError if the server of a remote model cannot be
    reached or fails. Neither is the contestant's fault.
    """
    generators = () if randomness is None or isinstance(randomness, ActionNumbers) else randomness
    before = [generator.bit_generator.state for generator in generators]
    try:
        answer = _call_batch(policy, batch, space, state, randomness)
    except (MemoryError, RemoteError):
        raise
    except Exception:
        for generator, mark in zip(generators, before, strict=True):
            generator.bit_generator.state = mark
        answer = _call_rows(policy, batch, space, state, randomness)
    mask = batch.observations.get(ACTION_MASK)
    legal = legal_rows(answer.actions, space, mask)
    if answer.faults or not legal.all():
        _check_mask(mask, space)
        for row in np.flatnonzero(~legal).tolist():
            answer.faults.setdefault(row, _illegal(answer.actions[row], space, mask, row))
    return answer


def action_fault(given: Actions, space: Leaf, mask: NDArray | None) -> PolicyFault | None:
    """Why the single action of a batch is unplayable, or None. Raises IllegalMask like `call_policy`."""
    try:
        _check_form(given, 1, space)
    except MalformedAction as error:
        return fault_of(error)
    if given.faults:
        return fault_of(given.faults[0])
    if legal_rows(given.actions, space, mask).all():
        return None
    _check_mask(mask, space)
    return _illegal(given.actions[0], space, mask, 0)


def fault_of(error: Exception) -> PolicyFault:
    """The fault of a policy that raised, with the line of the user's code, or whose output is malformed."""
    if isinstance(error, MalformedAction):
        return PolicyFault("malformed", str(error)[:MAX_DETAIL])
    place = raised_at(error)
    where = f" at {Path(place).name}" if place else ""
    return PolicyFault("crashed", f"{one_line(error, with_type=True)[: MAX_DETAIL - len(where)]}{where}")


def _call_batch(policy: Policy, batch: Batch, space: Leaf, state: State | None, randomness: Randomness) -> PolicyOutput:
    """Call the policy and check the form of its output. Raises whatever the policy raises."""
    if isinstance(randomness, ActionNumbers):
        assert isinstance(policy, OnnxPolicy | SearchPolicy), "scripts have generators"
        output = policy.act(batch.observations, state=state, explore=True, rng=randomness)
    else:
        output = policy.act(batch.observations, state=state, rng=randomness)
    _check_form(output, len(batch), space)
    return PolicyOutput(output.actions, output.state, {row: fault_of(error) for row, error in output.faults.items()})


def _call_rows(policy: Policy, batch: Batch, space: Leaf, state: State | None, randomness: Randomness) -> PolicyOutput:
    rows = len(batch)
    row_actions: dict[int, NDArray] = {}
    states: State = {}
    faults: dict[int, PolicyFault] = {}
    for row in range(rows):
        row_state = None if state is None else {name: array[[row]] for name, array in state.items()}
        draws: Randomness = None
        if isinstance(randomness, ActionNumbers):
            draws = randomness.row(row)
        elif randomness is not None:
            draws = [randomness[row]]
        try:
            answer = _call_batch(policy, batch.rows(np.array([row])), space, row_state, draws)
        except (MemoryError, RemoteError):
            raise
        except Exception as error:
            faults[row] = fault_of(error)
        else:
            row_actions[row] = answer.actions[0]
            faults |= {row + index: fault for index, fault in answer.faults.items()}
            for name, own_state in (answer.states or {}).items():
                states.setdefault(name, np.zeros((rows, *own_state.shape[1:]), own_state.dtype))[row] = own_state[0]
    # The policy's own dtype, as for a whole batch, because actions are recorded in it.
    actions = np.zeros((rows, *space.shape), np.result_type(*row_actions.values()) if row_actions else space.dtype)
    for row, action in row_actions.items():
        actions[row] = action
    return PolicyOutput(actions, states or None, faults)


def _check_form(given: Actions, rows: int, space: Leaf) -> None:
    """Raise MalformedAction unless each row has an action of the space's shape and kind, and a state if any."""
    kinds = "iu" if isinstance(space, Discrete | MultiDiscrete) else "iuf" if isinstance(space, Box) else "biuf"
    actions = given.actions
    if not isinstance(actions, np.ndarray) or actions.dtype.kind not in kinds or actions.shape != (rows, *space.shape):
        form = f"{actions.dtype} {list(actions.shape)}" if isinstance(actions, np.ndarray) else type(actions).__name__
        raise MalformedAction(f"actions are {form}, expected {space.dtype} {[rows, *space.shape]}")
    for name, array in (given.state or {}).items():
        if len(array) != rows:
            raise MalformedAction(f"{name} has {len(array)} rows, expected {rows}")


def _illegal(action: NDArray, space: Leaf, mask: NDArray | None, row: int) -> PolicyFault:
    if not np.isfinite(action).all():
        return PolicyFault("not_finite", f"action {action.tolist()}"[:MAX_DETAIL])
    legal = _legal(space, None if mask is None else mask[row])
    return PolicyFault("illegal_action", f"action {action.tolist()}, legal: {legal}"[:MAX_DETAIL])


def _legal(space: Leaf, mask: NDArray | None) -> str:
    """What a legal action is, in words."""
    match space:
        case Discrete(n=n, start=start) if mask is not None and mask[:n].any():
            return ", ".join(map(str, (np.flatnonzero(mask) + start).tolist()))
        case Discrete(n=n, start=start):
            return f"{start} to {start + n - 1}"
        case MultiDiscrete(nvec=nvec, start=start):
            masked = "" if mask is None else f", where action_mask is {mask.tolist()}"
            return f"from {start} on, {nvec} choices{masked}"
        case Box(low=low, high=high):
            return f"from {low} to {high}"
    return "0 or 1"


def _check_mask(mask: NDArray | None, space: Leaf) -> None:
    if mask is not None and allows_nothing(mask, space).any():
        raise IllegalMask("the environment's action_mask allows no action: expected at least one 1")
