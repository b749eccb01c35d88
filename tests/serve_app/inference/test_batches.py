"""Requests that arrive in one turn of the event loop are run together."""

import asyncio
from collections.abc import Iterator, Sequence
from typing import Any
from unittest.mock import Mock

import pytest

from league.errors import GraphTimeout, IllegalMask
from league.policies.policy import Actions, Arrays
from league.registry.registry import Registry
from league.settings import Storage
from serve_app.inference.action_request import JsonObservations, parse_action_request
from serve_app.inference.batches import Answer, Batches, GraphRun, RequestRows
from serve_app.inference.stream_codec import BinaryObservations
from serve_app.live_versions.policies import ActionOptions, ActionSelections, LoadedPolicy
from serve_app.live_versions.version_cache import load
from tests.support.clients.actions import BOARD, board_arrays, boards

DEFAULT = ActionOptions()


@pytest.fixture
def policy(storage: Storage) -> Iterator[LoadedPolicy]:
    """A policy of its own: a run that is too slow changes it."""
    registry = Registry.open(storage)
    policy = load(registry, "board", 1, 0.0, ActionSelections()).policy("shared")
    policy.inline_rows = 64  # however fast the machine is
    policy.inline_graph = policy.graph.within(60.0)
    yield policy
    registry.close()


@pytest.fixture
def batches(policy: LoadedPolicy, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The number of rows of each of its runs."""
    rows = list[int]()
    act = policy.inline_graph.act

    def counted(observations: Arrays, **options: Any) -> Actions:
        rows.append(len(observations["action_mask"]))
        return act(observations, **options)

    monkeypatch.setattr(policy.inline_graph, "act", counted)
    return rows


def binary(batch: list[Any]) -> BinaryObservations:
    return BinaryObservations([array.tobytes() for array in board_arrays(batch).values()], len(batch))


def together(policy: LoadedPolicy, requests: Sequence[RequestRows], options: ActionOptions = DEFAULT) -> list[Any]:
    """The outcomes of requests of one turn: actions, errors, or None."""
    waiting, outcomes = Batches(), list[Any]()

    async def run() -> None:
        for observations in requests:
            GraphRun(waiting, policy, observations, options).later(asyncio.get_running_loop(), outcomes.append)
        await asyncio.sleep(0)

    asyncio.run(run())
    assert len(outcomes) == len(requests)
    return [outcome.actions.tolist() if isinstance(outcome, Answer) else outcome for outcome in outcomes]


def test_messages_of_one_turn_are_one_batch(policy: LoadedPolicy, batches: list[int]) -> None:
    messages = [boards(8)[:rows] for rows in (1, 3, 8, 1)]
    expected = [policy.inline_graph.act(board_arrays(message)).actions.tolist() for message in messages]
    batches.clear()
    assert together(policy, list(map(binary, messages))) == expected
    assert batches == [13]
    assert len({action for actions in expected for action in actions}) > 1


def test_a_batch_has_at_most_the_rows_of_the_event_loop(policy: LoadedPolicy, batches: list[int]) -> None:
    policy.inline_rows = 4
    together(policy, [binary(boards(8)[:rows]) for rows in (3, 2, 2, 4, 1)])
    assert batches == [3, 4, 4, 1]


def test_sampled_actions_are_drawn_for_each_row(policy: LoadedPolicy, batches: list[int]) -> None:
    actions = together(policy, [binary([BOARD])] * 100, ActionOptions(explore=True))
    assert batches == [64, 36]
    assert len({action for (action,) in actions}) > 1
    assert all(BOARD["action_mask"][action] for (action,) in actions)


def test_an_error_is_that_of_its_message(policy: LoadedPolicy, batches: list[int]) -> None:
    expected = policy.inline_graph.act(board_arrays([BOARD])).actions.tolist()
    one, illegal = binary([BOARD]), binary([BOARD | {"action_mask": [0] * 7}])
    first, second, third = together(policy, [one, illegal, one])
    assert first == third == expected
    assert isinstance(second, IllegalMask)


def test_requests_are_one_batch_if_their_options_and_formats_are_equal(
    policy: LoadedPolicy, batches: list[int]
) -> None:
    waiting, loop = Batches(), Mock()
    request = parse_action_request({"observation": BOARD}, 8)
    json = JsonObservations(request.observations, is_plain=True, is_joinable=True, is_large=False)
    runs = [(binary([BOARD]), DEFAULT), (binary([BOARD]), ActionOptions(explore=False)), (json, DEFAULT)]
    for observations, options in runs * 2:
        GraphRun(waiting, policy, observations, options).later(loop, Mock())
    waiting.flush()
    assert batches == [2, 2, 2]
    loop.call_soon.assert_called_once_with(waiting.flush)
    waiting.flush()
    assert batches == [2, 2, 2], "nothing waits any more"


def test_a_task_does_not_wait_for_the_turn(policy: LoadedPolicy, batches: list[int]) -> None:
    async def run() -> Any:
        waiting = Batches()
        return await GraphRun(waiting, policy, binary([BOARD]), DEFAULT), waiting

    answer, waiting = asyncio.run(run())
    assert (batches, answer.runs) == ([1], 1)
    assert not waiting._waiting


def test_a_failing_answer_does_not_prevent_others(policy: LoadedPolicy) -> None:
    waiting, loop, callback = Batches(), Mock(), Mock()
    for go_on in (callback, Mock(side_effect=RuntimeError("a bug")), callback):
        GraphRun(waiting, policy, binary([BOARD]), DEFAULT).later(loop, go_on)
    waiting.flush()
    assert callback.call_count == 2


def test_a_slow_policy_occupies_the_event_loop_once(policy: LoadedPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_out_of_time(*_: Any, **__: Any) -> None:
        monkeypatch.undo()
        raise GraphTimeout("too slow")

    monkeypatch.setattr(policy.inline_graph, "act", run_out_of_time)
    assert together(policy, [binary([BOARD])] * 100) == [None] * 100, "of later batches, too"
    assert policy.inline_rows == 0
