"""A contestant is asked for its actions, and what it answers is looked at row by row: an action that can be played, or
a fault for which that row's game is forfeited.

The answer to a row must not depend on the batch around it. So where a policy fails on a batch, it is asked for each
row alone, with the row's generator as it was before: games in which it can act come out as if the others had not been
there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from evaluation.running import State
from league.environments.legality import allows_nothing, legal_rows
from league.environments.stepping import Batch
from league.errors import IllegalMask
from league.policies.policy import Actions, Policy
from league.results.records import Reason
from league.spaces import ACTION_MASK, Box, Discrete, Leaf, MultiDiscrete

Generators = Sequence[np.random.Generator]


@dataclass(frozen=True, slots=True)
class Fault:
    """Why a row has no action that could be played. detail: for a person, and not the same on every machine."""

    reason: Reason
    detail: str


@dataclass(slots=True)
class Answer:
    """Actions (k, …) and recurrent state of k rows, None for a policy without; of rows with a fault they mean nothing.

    faults: by row.
    """

    actions: NDArray
    states: list[State] | None
    faults: dict[int, Fault] = field(default_factory=dict)


def ask(policy: Policy, batch: Batch, space: Leaf, state: State | None, generators: Generators | None) -> Answer:
    """What a policy that acts in `space` answers to a batch.

    generators: one of each row for a policy that draws, else None.
    Raises IllegalMask where the environment allows no action at all: that is no contestant's fault.
    """
    before = None if generators is None else [each.bit_generator.state for each in generators]
    try:
        answer = _answer(policy, batch, space, state, generators)
    except MemoryError:
        raise
    except Exception:
        if generators is not None and before is not None:
            for each, mark in zip(generators, before, strict=True):
                each.bit_generator.state = mark
        answer = _one_by_one(policy, batch, space, state, generators)
    mask = batch.observations.get(ACTION_MASK)
    legal = legal_rows(answer.actions, space, mask)
    if answer.faults or not legal.all():
        _check_mask(mask, space)
        for row in np.flatnonzero(~legal).tolist():
            answer.faults.setdefault(row, _illegal(answer.actions[row], mask, row))
    return answer


def fault_of(given: Actions, space: Leaf, mask: NDArray | None) -> Fault | None:
    """Why the action of a batch of one row cannot be played; None if it can. Raises IllegalMask as `ask` does."""
    try:
        _check_form(given, 1, space)
    except _Malformed as error:
        return Fault("malformed", str(error))
    if legal_rows(given.actions, space, mask).all():
        return None
    _check_mask(mask, space)
    return _illegal(given.actions[0], mask, 0)


class _Malformed(Exception):
    """An answer that is no array of actions."""


def _answer(policy: Policy, batch: Batch, space: Leaf, state: State | None, generators: Generators | None) -> Answer:
    """The answer as it is, if it has the form of one. Raises whatever the policy does."""
    rows = len(batch.copies)
    given = policy.act(batch.observations, state=state, rng=generators)
    _check_form(given, rows, space)
    if given.state is None:
        return Answer(given.actions, None)
    return Answer(given.actions, [{name: array[row] for name, array in given.state.items()} for row in range(rows)])


def _one_by_one(
    policy: Policy, batch: Batch, space: Leaf, state: State | None, generators: Generators | None
) -> Answer:
    rows = len(batch.copies)
    given: dict[int, NDArray] = {}
    states: list[State] = [{} for _ in range(rows)]
    faults: dict[int, Fault] = {}
    for row in range(rows):
        own = None if state is None else {name: array[[row]] for name, array in state.items()}
        draws = None if generators is None else [generators[row]]
        try:
            answer = _answer(policy, batch.rows([row]), space, own, draws)
        except MemoryError:
            raise
        except _Malformed as error:
            faults[row] = Fault("malformed", str(error))
        except Exception as error:
            faults[row] = Fault("crashed", f"{type(error).__name__}: {error}")
        else:
            given[row] = answer.actions[0]
            states[row] = answer.states[0] if answer.states else {}
    # In the type that the policy gives them in, as in a whole batch: that is how they are recorded.
    actions = np.zeros((rows, *space.shape), np.result_type(*given.values()) if given else space.dtype)
    for row, action in given.items():
        actions[row] = action
    return Answer(actions, states if any(states) else None, faults)


def _check_form(given: Actions, rows: int, space: Leaf) -> None:
    """Raise _Malformed unless there is an action of the space's shape and kind, and state if any, for each row."""
    kinds = "iu" if isinstance(space, Discrete | MultiDiscrete) else "iuf" if isinstance(space, Box) else "biuf"
    actions = given.actions
    if not isinstance(actions, np.ndarray) or actions.dtype.kind not in kinds or actions.shape != (rows, *space.shape):
        found = f"{actions.dtype} {list(actions.shape)}" if isinstance(actions, np.ndarray) else type(actions).__name__
        raise _Malformed(f"actions are {found}, expected {space.dtype} {[rows, *space.shape]}")
    for name, array in (given.state or {}).items():
        if len(array) != rows:
            raise _Malformed(f"{name} has {len(array)} rows, expected {rows}")


def _illegal(action: NDArray, mask: NDArray | None, row: int) -> Fault:
    if not np.isfinite(action).all():
        return Fault("not_finite", f"action {action.tolist()}")
    allowed = "" if mask is None else f", where action_mask is {mask[row].tolist()}"
    return Fault("illegal_action", f"action {action.tolist()}{allowed}")


def _check_mask(mask: NDArray | None, space: Leaf) -> None:
    if mask is not None and allows_nothing(mask, space).any():
        raise IllegalMask("the environment's action_mask allows no action: expected at least one 1")
