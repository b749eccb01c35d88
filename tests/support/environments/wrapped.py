"""PettingZoo's environments with SuperSuit's wrappers, and episodes that must equal theirs."""

from typing import Any

import numpy as np
import supersuit


def with_supersuit(env: Any, wrappers: list[Any]) -> Any:
    for wrapper in wrappers:
        name, arguments = (wrapper, {}) if isinstance(wrapper, str) else next(iter(wrapper.items()))
        values = {key: tuple(value) if isinstance(value, list) else value for key, value in arguments.items()}
        env = getattr(supersuit, name)(env, **values)
    return env


def assert_same_episodes(ours: Any, theirs: Any) -> None:
    """Two Parallel environments have the same spaces, and report the same in two episodes."""
    for agent in theirs.possible_agents:
        assert ours.observation_space(agent) == theirs.observation_space(agent)
        theirs.action_space(agent).seed(5)
    for seed in range(2):
        actual, _ = ours.reset(seed=seed)
        expected, _ = theirs.reset(seed=seed)
        returned: list[tuple[np.ndarray, np.ndarray]] = []
        while True:
            assert list(actual) == list(expected)
            for agent, observation in expected.items():
                assert actual[agent].dtype == observation.dtype
                np.testing.assert_array_equal(actual[agent], observation)
                returned.append((actual[agent], observation.copy()))
            if not theirs.agents:
                break
            actions = {agent: theirs.action_space(agent).sample() for agent in theirs.agents}
            actual, *reports, _ = ours.step(dict(actions))
            expected, *due, _ = theirs.step(dict(actions))
            assert [dict(report) for report in reports] == [dict(report) for report in due]
            assert ours.agents == theirs.agents
        for array, at_its_time in returned[:40]:
            np.testing.assert_array_equal(array, at_its_time, err_msg="returned arrays must not be modified later")
