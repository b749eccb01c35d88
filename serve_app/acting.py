"""From what is asked to what is answered: observations read, the graph run, its actions as JSON values."""

import asyncio
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from league.errors import InvalidState
from league.policies.policy import Actions
from league.policies.probabilities import probabilities
from league.seeds import generator
from league.spaces import ACTION_MASK
from serve_app.asks import Ask
from serve_app.loading import LoadedPolicy, LoadedVersion
from serve_app.observations import read_state, refuse_strings
from serve_app.tokens import read_state as state_of_tokens
from serve_app.tokens import write_tokens

Arrays = dict[str, NDArray]


def is_plain(ask: Ask, policy: LoadedPolicy, quotes: int) -> bool:
    """Whether no value is a string, by the quotation marks of a request: two for each string.

    If there are more strings than keys, a key is wrong, or something is base64.
    """
    return quotes == 2 * (ask.strings + len(ask.observations) * policy.reader.keys)


def read_given_state(ask: Ask, version: LoadedVersion, policy: LoadedPolicy, has_strings: bool = True) -> Arrays | None:
    """The recurrent state that came with the request. Raises ObservationError or InvalidState."""
    if not ask.state and not any(ask.tokens or ()):
        return None
    if not policy.state:
        raise InvalidState("state must be null: this policy is not recurrent")
    if ask.tokens is not None:
        return state_of_tokens(ask.tokens, version.model(policy), version.sha256, policy.state)
    if has_strings:
        refuse_strings(ask.state)
    return read_state(ask.state, policy.state, len(ask.observations))


def written_state(answer: Actions, version: LoadedVersion, policy: LoadedPolicy) -> list[str]:
    """The new state as tokens."""
    assert answer.state is not None
    return write_tokens(version.model(policy), version.number, version.sha256, answer.state)


async def act(
    policy: LoadedPolicy,
    observations: Arrays,
    state: Arrays | None,
    rng: Sequence[np.random.Generator] | None = None,
    with_distribution: bool = False,
) -> Actions:
    """Run the graph, in a thread if that takes long. rng: explore, with one generator per row."""

    def run() -> Actions:
        if with_distribution and rng is None:
            return policy.policy.distribution(observations, state=state)
        return policy.policy.act(observations, state=state, explore=rng is not None, rng=rng)

    rows = len(next(iter(observations.values())))
    return run() if rows <= policy.inline_rows else await asyncio.to_thread(run)


async def act_as_asked(ask: Ask, policy: LoadedPolicy, observations: Arrays, state: Arrays | None) -> Actions:
    """Run the graph with the request's seed."""
    rng = generators(ask.seed, len(ask.observations)) if ask.explore else None
    return await act(policy, observations, state, rng, ask.probabilities)


def reply_to(ask: Ask, answer: Actions, observations: Arrays, policy: LoadedPolicy) -> dict[str, Any]:
    """The reply's `action` or `actions`, and its `probabilities`."""
    actions = answer.actions.tolist()
    reply = {"actions": actions} if ask.is_batch else {"action": actions[0]}
    if ask.probabilities:
        assert answer.dist_inputs is not None
        likely = probabilities(answer.dist_inputs, policy.manifest.action, observations.get(ACTION_MASK))
        reply["probabilities"] = likely if ask.is_batch else likely[0]
    return reply


def generators(seed: int | list[int] | None, rows: int) -> Sequence[np.random.Generator]:
    """One per row, so that an answer does not depend on the batch that it was asked for in."""
    if seed is None:
        return [np.random.default_rng() for _ in range(rows)]
    if isinstance(seed, list):
        return [generator(own, 0) for own in seed]
    return [generator(seed, row) for row in range(rows)]
