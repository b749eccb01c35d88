"""Messages of simulators: whatever they send is either read or refused, and what is read is within its bounds."""

import json
from typing import Any

import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.environments.external.messages import Abandoned, MessageCodec, Reports
from league.errors import IllegalMask, InvalidInput, InvalidReward, LeagueError, ObservationError
from league.interface import AgentInterface
from league.spaces import Box, DictSpace, Discrete
from policy_league_client.simulator import ACTIONS, HEADER, PROTOCOL, REPORTS

MASKED = DictSpace(
    spaces={
        "observation": Box(dtype="int8", shape=(2,), low=0, high=3),
        "action_mask": Box(dtype="int8", shape=(3,), low=0, high=1),
    }
)


PLAIN = Box(dtype="float32", shape=(4,), low=None, high=None)


AGENTS = {
    "red": AgentInterface(observation=MASKED, action=Discrete(n=3)),
    "blue": AgentInterface(observation=MASKED, action=Discrete(n=3)),
    "referee": AgentInterface(observation=PLAIN, action=Box(dtype="float32", shape=(2,), low=-1, high=1)),
}


CODEC = MessageCodec(AGENTS)


SEEN = {"observation": [1, 2], "action_mask": [1, 0, 1]}


def reports(*rows: dict[str, Any], **keys: Any) -> str:
    return json.dumps({"type": "reports", "reports": list(rows), **keys})


def report(**keys: Any) -> dict[str, Any]:
    return {"episode": 7, "agent": "red", "observation": SEEN, "reward": 0.5} | keys


def binary(rows: int, layout: int = 0, flags: int = 0, rewards: float = 0.0, agent: int = 0) -> bytes:
    mask = np.ones((rows, 3), np.int8) if layout == 0 else np.zeros((rows, 0), np.int8)
    observed = np.zeros((rows, 2), np.int8) if layout == 0 else np.zeros((rows, 4), "<f4")
    columns = (
        np.full(rows, rewards, "<f8"),
        np.arange(rows, dtype="<u4"),
        np.full(rows, agent, "<u2"),
        np.full(rows, flags, np.uint8),
        observed,
        mask,
    )
    return HEADER.pack(PROTOCOL, REPORTS, layout, rows) + b"".join(column.tobytes() for column in columns)


def test_agents_with_equal_spaces_share_a_layout() -> None:
    document = orjson.loads(CODEC.welcome("game"))
    assert [layout["agents"] for layout in document["layouts"]] == [["red", "blue"], ["referee"]]
    assert document["layouts"][0]["inputs"] == [
        {"name": "observation", "path": ["observation"], "dtype": "int8", "shape": [2]},
        {"name": "action_mask", "path": ["action_mask"], "dtype": "int8", "shape": [3]},
    ]
    assert document["layouts"][1]["action"] == {"dtype": "float32", "shape": [2]}


def test_reports_are_read_by_layout() -> None:
    message = CODEC.read(
        reports(
            report(),
            report(agent="referee", observation=[0, 1, 2, 3.5], reward=1),
            report(agent="blue", episode=8, terminated=True, observation=SEEN | {"action_mask": [0, 0, 0]}),
            over=[8],
        )
    )
    assert isinstance(message, Reports)
    first, referee, last = message.rows
    assert (first.envs.tolist(), first.agents.tolist(), first.rewards.tolist()) == ([7], [0], [0.5])
    assert referee.observations["observation"].dtype == np.float32
    assert last.terminations.tolist() == [True]
    assert message.over == [8]


def test_actions_are_written_in_both_forms() -> None:
    arguments = 1, np.array([5, 6]), np.array([2, 2]), np.array([[0.5, 1], [0, -1]])
    text = CODEC.actions(*arguments, binary=False)
    assert orjson.loads(text)["actions"][1] == {"episode": 6, "agent": "referee", "action": [0.0, -1.0]}
    message = CODEC.actions(*arguments, binary=True)
    assert isinstance(message, bytes)
    assert HEADER.unpack_from(message) == (PROTOCOL, ACTIONS, 1, 2)
    np.testing.assert_array_equal(np.frombuffer(message, "<f4", offset=HEADER.size + 2 * 6), [0.5, 1, 0, -1])


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**65), 2**65) | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from([*SEEN, "x"]), inner, max_size=3),
    max_leaves=12,
)


documents = st.fixed_dictionaries(
    {"type": st.sampled_from(["reports", "abandon", "hello"])},
    optional={
        "reports": st.lists(
            st.fixed_dictionaries(
                {},
                optional={
                    "episode": st.integers(0, 9) | values,
                    "agent": st.sampled_from([*AGENTS]) | values,
                    "observation": st.just(SEEN) | values,
                    "reward": st.floats() | values,
                    "terminated": st.booleans() | values,
                },
            ),
            max_size=3,
        )
        | values,
        "over": values,
        "episodes": values,
    },
)


@given(st.one_of(documents.map(json.dumps), st.binary(max_size=80), st.binary(max_size=90).map(lambda b: b"\1\1" + b)))
def test_any_message_is_read_or_refused(message: str | bytes) -> None:
    try:
        read = CODEC.read(message)
    except LeagueError:
        return
    if isinstance(read, Abandoned):
        assert all(0 <= episode < 2**32 for episode in read.episodes)
        return
    for rows in read.rows:
        assert np.isfinite(rows.rewards).all()
        layout = CODEC.layouts[CODEC.layout_of[rows.agents[0]]]
        assert np.isin(rows.agents, layout.agents).all()
        if "action_mask" in rows.observations:
            assert rows.observations["action_mask"][~rows.has_ended].any(axis=1).all()


def test_binary_reports_are_read_by_blocks() -> None:
    message = CODEC.read(binary(3, flags=2 | 4), episodes=1)
    assert isinstance(message, Reports)
    (rows,) = message.rows
    assert rows.truncations.all()
    assert not rows.terminations.any()
    assert message.over == [0, 1, 2]
    assert rows.observations["action_mask"].shape == (3, 3)
    message = CODEC.read(binary(2) + binary(1, layout=1, flags=4, agent=2))
    assert isinstance(message, Reports)
    assert [rows.agents.tolist() for rows in message.rows] == [[0, 0], [2]]
    assert message.over == [0]
    for too_many, reason in ((binary(4), "number of rows is 4"), (reports(*[report()] * 4), "at most 3 objects")):
        with pytest.raises(InvalidInput, match=reason):
            CODEC.read(too_many, episodes=1)


INVALID: list[tuple[str | bytes, str]] = [
    ("[", "no JSON"),
    ("[]", "a list, expected an object"),
    ('{"type": "begin"}', "type 'begin'"),
    (reports(report(agent="green")), "'green' is no agent"),
    (reports(report(episode=-1)), "episode is -1"),
    (reports(report(episode=2**40)), "expected an integer"),
    (reports(report(episode=True)), "episode is True"),
    (reports(report(reward="1")), "reward of red is a string"),
    (reports(report(reward=1e999)), "no JSON"),
    (reports(report(terminated=1)), "must be booleans"),
    (reports(report(colour=1)), "unknown key 'colour'"),
    (reports({"episode": 1, "agent": "red"}), "lacks the key observation"),
    (reports(report(), over="all"), "over must be a list"),
    (json.dumps({"type": "abandon", "episodes": [None]}), "episodes is None"),
    (b"", "0 bytes"),
    (b"\2\1" + binary(1)[2:], "starts with"),
    (binary(1) + b"\0", "has 1 bytes, expected a header"),
    (HEADER.pack(PROTOCOL, REPORTS, 9, 1), "layout is 9"),
    (HEADER.pack(PROTOCOL, REPORTS, 0, 2**31), "number of rows"),
    (HEADER.pack(PROTOCOL, REPORTS, 0, 0), "number of rows"),
    (binary(1, agent=2), "agent 2 is not one of layout 0"),
    (binary(1, flags=8), "flags 8"),
]


INVALID_VALUES: list[tuple[str | bytes, type[LeagueError], str]] = [
    (reports(report(observation=[1, 2])), ObservationError, "expected an object"),
    (reports(report(observation=SEEN | {"observation": [1, 2, 3]})), ObservationError, "shape"),
    (reports(report(observation=SEEN | {"observation": [1, "2"]})), ObservationError, "string"),
    (reports(report(observation=SEEN | {"action_mask": [0, 0, 0]})), IllegalMask, "allows no action"),
    (binary(1)[:-1], ObservationError, "bytes, expected"),
    (binary(1)[:10], ObservationError, "1 reports have 2 bytes"),
    (binary(1, rewards=float("nan")), InvalidReward, "nan"),
]


def test_invalid_messages_are_refused_by_name(subtests: pytest.Subtests) -> None:
    for message, error, match in (*((message, InvalidInput, match) for message, match in INVALID), *INVALID_VALUES):
        with subtests.test(message=message[:200]), pytest.raises(error, match=match):
            CODEC.read(message)


def test_an_invalid_greeting_is_refused() -> None:
    simulator = {"name": "x", "version": "1"}
    for changes, match in (
        ({"type": "reports"}, "expected 'hello'"),
        ({"protocol": 2}, "protocol is 2"),
        ({"simulator": None}, "name and version"),
        ({"simulator": {"name": "x", "version": 1}}, "two strings"),
        ({"episodes": 0}, "episodes is 0"),
    ):
        document = {"type": "hello", "protocol": 1, "simulator": simulator} | changes
        with pytest.raises(InvalidInput, match=match):
            CODEC.hello(json.dumps({key: value for key, value in document.items() if value is not None}))
