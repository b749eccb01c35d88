from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from league.config.environment import EnvironmentConfig
from league.environments.equality import compare
from league.environments.vector.vector_env import AgentRows
from tests.support.environments.vector_copies import Looped


def config(entry_point: str, **kwargs: Any) -> EnvironmentConfig:
    return EnvironmentConfig(entry_point=entry_point, kwargs=kwargs)


COUNTING = "tests.support.environments.counting:counting"


MEETING = "tests.support.environments.simultaneous:meeting"


ENVIRONMENTS = {
    "AEC with masks": config("pettingzoo.classic.tictactoe_v3"),
    "AEC with early deaths": config(COUNTING, lives=[1, 4, 2, 4], truncated=[1, 2]),
    "Parallel with states": config("mpe2.simple_spread_v3", max_cycles=5),
    "different spaces and Box actions": config("mpe2.simple_tag_v3", max_cycles=5, continuous_actions=True),
    "different action spaces": config("mpe2.simple_speaker_listener_v4", max_cycles=5),
    "late arrivals": config(MEETING, arrives=[0, 1, 2], leaves=[4, 2, 4], truncated=[1]),
    "RLlib": config("tests.support.environments.simultaneous:rllib_meeting"),
}


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_equal_environment_has_no_difference(name: str) -> None:
    comparison = compare(ENVIRONMENTS[name], Looped(ENVIRONMENTS[name], 3), steps=150, seed=0)
    assert comparison.difference is None
    assert 150 <= comparison.steps < 153
    assert comparison.episodes > 5
    assert comparison.stock_rate > 0


class Altered(Looped):
    """Reports are altered by `alter`, which gets each AgentRows and the number of the call."""

    def __init__(self, config: EnvironmentConfig, alter: Callable[[AgentRows, int], AgentRows]) -> None:
        super().__init__(config, 2)
        self._alter, self._calls = alter, 0

    def _rows(self, reports: Any) -> list[AgentRows]:
        self._calls += 1
        return [self._alter(rows, self._calls) for rows in super()._rows(reports)]


def difference(alter: Callable[[AgentRows, int], AgentRows]) -> str:
    stock = ENVIRONMENTS["AEC with masks"]
    return compare(stock, Altered(stock, alter), steps=150, seed=1).difference or ""


def column(name: str, change: Callable[[NDArray], NDArray]) -> Callable[[AgentRows, int], AgentRows]:
    return lambda rows, call: replace(rows, **{name: change(getattr(rows, name))})


def observation(name: str, change: Callable[[NDArray], NDArray]) -> Callable[[AgentRows, int], AgentRows]:
    return lambda rows, call: replace(rows, observations={**rows.observations, name: change(rows.observations[name])})


def changed(array: NDArray, *index: int) -> NDArray:
    array = array.copy()
    array[index] += 1
    return array


def test_the_text_names_copy_seed_step_agent_element_and_both_values() -> None:
    def later(rows: AgentRows, call: int) -> AgentRows:
        alter = observation("observation", lambda array: changed(array, 0, 2, 1, 0))
        return alter(rows, call) if call > 2 else rows

    text = difference(later)
    assert text.startswith("copy ")
    assert "seed " in text
    assert ", player_" in text
    assert "observation[2, 1, 0] is " in text
    assert "in the stock environment" in text
    assert "\n" not in text


def test_each_column_is_compared(subtests: pytest.Subtests) -> None:
    for alter, expected in (
        (column("rewards", lambda rewards: -rewards), "rewards is -0.0, in the stock environment 0.0"),
        (column("rewards", lambda rewards: np.nextafter(rewards, 1)), "rewards is 5e-324"),
        (column("rewards", lambda rewards: rewards.astype(np.float32)), "rewards is float32[2]"),
        (column("terminations", np.logical_not), "terminations is True"),
        (column("truncations", np.logical_not), "truncations is True"),
        (column("agents", lambda agents: 1 - agents), "agent 1, in the stock environment of copy 0, seed "),
        (column("envs", lambda envs: envs + 1), "row 0 is of copy 1, agent 0"),
        (column("envs", lambda envs: envs.astype(np.int32)), "envs is int32[2]"),
        (observation("observation", lambda o: o.astype(np.uint8)), "observation is uint8[2, 3, 3, 2]"),
        (observation("observation", lambda o: o.reshape(len(o), -1)), "observation is int8[2, 18]"),
        (observation("action_mask", lambda mask: changed(mask, 0, 3)), "action_mask[3] is 2"),
        (lambda rows, call: replace(rows, observations={"observation": rows.observations["observation"]}), "action_"),
    ):
        with subtests.test(expected=expected):
            assert expected in difference(alter)


def test_missing_and_exchanged_rows_are_found() -> None:
    def every(rows: AgentRows, indices: NDArray) -> AgentRows:
        observations = {name: array[indices] for name, array in rows.observations.items()}
        columns = (getattr(rows, name)[indices] for name in ("rewards", "terminations", "truncations"))
        return AgentRows(rows.envs[indices], rows.agents[indices], observations, *columns)

    assert "row 1 is missing" in difference(lambda rows, call: every(rows, np.arange(min(len(rows.envs), 1))))
    backwards = difference(lambda rows, call: every(rows, np.arange(len(rows.envs))[::-1]))
    assert "row 0 is of copy 1, agent 0, in the stock environment of copy 0" in backwards


def test_arrays_that_are_changed_later_are_found() -> None:
    buffers: list[NDArray] = []

    def reused(array: NDArray) -> NDArray:
        """The array of two calls before, with new contents."""
        buffers.append(np.zeros((4, *array.shape[1:]), array.dtype) if len(buffers) < 2 else buffers[-2])
        buffers[-1][: len(array)] = array
        return buffers[-1][: len(array)]

    assert "(changed after it was reported)" in difference(observation("observation", reused))


class LendsActions(Looped):
    """Rock paper scissors. Observations are in the array of the actions."""

    def step(self, env_ids: NDArray[np.int64], actions: NDArray) -> Sequence[AgentRows]:
        (rows,) = super().step(env_ids, actions)
        actions[:] = rows.observations["observation"]
        return [replace(rows, observations={"observation": actions})]


def test_the_caller_may_reuse_its_actions() -> None:
    stock = config("pettingzoo.classic.rps_v2")
    comparison = compare(stock, LendsActions(stock, 2), 50, seed=0)
    assert "observation is 0, in the stock environment" in (comparison.difference or "")


class OtherState(Looped):
    """Its state is what `alter` returns."""

    def __init__(self, config: EnvironmentConfig, alter: Callable[[Any], Any]) -> None:
        super().__init__(config, 2)
        self._alter = alter

    def state(self, env_ids: NDArray[np.int64]) -> Any:
        return self._alter(super().state(env_ids))


def test_states_and_agents_are_compared() -> None:
    for name, alter, expected in (
        ("Parallel with states", lambda states: np.nextafter(states, np.float32(1)), "step 0: state[0] is "),
        ("Parallel with states", lambda _: None, "has no state, but the stock environment has one"),
        ("AEC with masks", lambda _: np.zeros((2, 1), np.float32), "has a state, the stock environment has none"),
    ):
        assert expected in (
            compare(ENVIRONMENTS[name], OtherState(ENVIRONMENTS[name], alter), 20, seed=0).difference or ""
        )
    comparison = compare(ENVIRONMENTS["AEC with masks"], Looped(config(COUNTING, lives=[1, 2]), 1), 10, seed=0)
    assert "possible_agents is ('player_0', 'player_1'), in the stock environment" in (comparison.difference or "")


def test_the_same_seed_gives_the_same_comparison() -> None:
    spread = ENVIRONMENTS["Parallel with states"]
    runs = [compare(spread, Looped(spread, 3), steps=100, seed=seed) for seed in (4, 4, 5)]
    first, again, other = ((run.steps, run.episodes) for run in runs)
    assert first == again != other
