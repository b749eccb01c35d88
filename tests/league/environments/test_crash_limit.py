import numpy as np
import pytest

from league.environments.crash_limit import CrashLimit


def test_the_crash_after_the_most_is_raised(caplog: pytest.LogCaptureFixture) -> None:
    crashes = CrashLimit(num_envs=2, most=2)
    crashes.count(1, 7, ValueError("first"))
    crashes.count(1, 8, ValueError("second"))
    assert "seed 8" in caplog.messages[1]
    assert "(2 of 2 consecutive times): ValueError: second" in caplog.messages[1]
    with pytest.raises(ValueError, match="third"):
        crashes.count(1, 9, ValueError("third"))


def test_a_finished_episode_ends_the_count_of_its_environment() -> None:
    crashes = CrashLimit(num_envs=2, most=1)
    for env in (0, 1):
        crashes.count(env, 0, ValueError("first"))
    crashes.finish(np.array([0]))
    crashes.count(0, 0, ValueError("second"))
    with pytest.raises(ValueError, match="second"):
        crashes.count(1, 0, ValueError("second"))
