"""Messages of several streams that are run together: their actions, their batches, and what happens if a run fails."""

import asyncio
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from league.errors import GraphTimeout, ObservationError
from league.policies.policy import Actions
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.inference.action_request import Arrays
from serve_app.inference.stream_batches import StreamBatches
from serve_app.live_versions import version_cache
from serve_app.live_versions.version_cache import ActionSelections, LoadedPolicy
from tests.support.clients.actions import BOARD, boards


@pytest.fixture
def policy(storage: Storage) -> Iterator[LoadedPolicy]:
    """A policy of its own: a run that is too slow changes it."""
    registry = Registry.open(storage)
    policy = version_cache.load(registry, "board", 1, 0.0, ActionSelections()).policy("shared")
    policy.inline_rows = 64  # however fast the machine is
    policy.inline_policy = policy.policy.within(60.0)
    yield policy
    registry.close()


@pytest.fixture
def batches(policy: LoadedPolicy, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of rows of each of its runs."""
    rows = list[int]()
    act = policy.inline_policy.act

    def counted(observations: Arrays, **options: Any) -> Actions:
        rows.append(len(observations["action_mask"]))
        return act(observations, **options)

    monkeypatch.setattr(policy.inline_policy, "act", counted)
    return rows


def arrays(observations: list[dict[str, Any]]) -> Arrays:
    return {name: np.array([board[name] for board in observations], np.int8) for name in BOARD}


async def together(policy: LoadedPolicy, messages: list[Arrays], explore: bool = False) -> list[Any]:
    """What messages of one turn are answered, as the protocol of their connections awaits it."""
    waiting, outcomes, loop = StreamBatches(), [None] * len(messages), asyncio.get_running_loop()
    for index, observations in enumerate(messages):
        rows = len(observations["action_mask"])
        steps = waiting.act(policy, observations, rows, explore).__await__()

        def go_on(outcome: Any, steps: Any = steps, index: int = index) -> None:
            try:
                steps.throw(outcome) if isinstance(outcome, Exception) else steps.send(outcome)
                outcomes[index] = "awaits a thread"
            except StopIteration as done:
                outcomes[index] = done.value.actions.tolist()
            except Exception as error:
                outcomes[index] = error

        steps.send(None).later(loop, go_on)
    await asyncio.sleep(0)
    assert None not in outcomes
    return outcomes


def test_messages_of_one_turn_are_one_batch(policy: LoadedPolicy, batches: list[int]) -> None:
    messages = [arrays(boards(8)[:rows]) for rows in (1, 3, 8, 1)]
    expected = [policy.inline_policy.act(message).actions.tolist() for message in messages]
    batches.clear()
    assert asyncio.run(together(policy, messages)) == expected
    assert batches == [13]
    assert len({action for actions in expected for action in actions}) > 1


def test_a_batch_has_at_most_the_rows_of_the_event_loop(policy: LoadedPolicy, batches: list[int]) -> None:
    policy.inline_rows = 4
    messages = [arrays(boards(8)[:rows]) for rows in (3, 2, 2, 4, 1)]
    asyncio.run(together(policy, messages))
    assert batches == [3, 4, 4, 1]


def test_sampled_actions_are_drawn_for_each_row(policy: LoadedPolicy, batches: list[int]) -> None:
    one = arrays([BOARD])
    actions = asyncio.run(together(policy, [one] * 100, explore=True))
    assert batches == [64, 36]
    assert len({action for (action,) in actions}) > 1
    assert all(BOARD["action_mask"][action] for (action,) in actions)


def test_an_error_is_that_of_its_message(policy: LoadedPolicy, batches: list[int]) -> None:
    one = arrays([BOARD])
    expected = policy.inline_policy.act(one).actions.tolist()
    wrong = one | {"observation": one["observation"].astype(np.float32)}
    first, second, third = asyncio.run(together(policy, [one, wrong, one]))
    assert first == third == expected
    assert isinstance(second, ObservationError)


def test_messages_of_a_slow_policy_run_in_threads(policy: LoadedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_out_of_time(*_: Any, **__: Any) -> None:
        monkeypatch.undo()
        raise GraphTimeout("too slow")

    monkeypatch.setattr(policy.inline_policy, "act", run_out_of_time)
    assert asyncio.run(together(policy, [arrays([BOARD])] * 100)) == ["awaits a thread"] * 100, "of later batches, too"
    assert policy.inline_rows == 0
