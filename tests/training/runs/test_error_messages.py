"""Errors that pass through several processes, like those of an environment: runner, learner, driver."""

from pathlib import Path

import pytest
import ray

from league.errors import InvalidReward
from training.runs.error_messages import training_error

TRACE = Path("/runs/error.txt")


def through_processes(fault: Exception) -> BaseException:
    """The exception that the driver gets if a task of a task raises."""

    @ray.remote(num_cpus=0.1)
    def runner() -> None:
        raise fault

    @ray.remote(num_cpus=0.1)
    def learner() -> None:
        ray.get(runner.remote())

    with pytest.raises(type(fault)) as raised:
        ray.get(learner.remote())
    return raised.value


@pytest.mark.usefixtures("ray_session")
def test_our_errors_are_unchanged() -> None:
    error = training_error(through_processes(InvalidReward("league a: player_1: nan")), "a", TRACE)
    assert type(error) is InvalidReward
    assert str(error) == "league a: player_1: nan"


@pytest.mark.usefixtures("ray_session")
def test_other_errors_have_type_message_and_line_of_the_user_code() -> None:
    error = training_error(through_processes(KeyError("ball\nand more")), "a", TRACE)
    line = next(n for n, text in enumerate(Path(__file__).read_text().splitlines(), 1) if "raise fault" in text)
    assert str(error).startswith("league a: training failed with KeyError: 'ball\\nand more' at ")
    assert f"{__file__}:{line};" in str(error)
    assert str(error).endswith("see the traceback in /runs/error.txt")


@pytest.mark.usefixtures("ray_session")
def test_notes_name_the_episode() -> None:
    fault = KeyError("ball")
    fault.add_note("in the episode with seed 7")
    assert " in the episode with seed 7; see the traceback" in str(training_error(through_processes(fault), "a", TRACE))


def test_an_error_without_message_or_line() -> None:
    assert str(training_error(MemoryError(), "a", TRACE)) == (
        "league a: training failed with MemoryError; see the traceback in /runs/error.txt"
    )
