"""Where a run is placed, and what is said about its errors, which pass through several processes."""

from pathlib import Path

import pytest
import ray

from league import ray_cluster
from league.errors import ConfigError, InvalidReward
from training.algorithms.resources import Resources
from training.runs import tune
from training.runs.error_messages import training_error
from training.runs.tune import cpu_share, placement


@pytest.mark.usefixtures("ray_session")
def test_learner_and_runners_share_the_available_cpus() -> None:
    """Tests have two CPUs."""
    assert [cpu_share(1), cpu_share(2), cpu_share(4), cpu_share(2, at_once=2)] == pytest.approx([1.0, 1.0, 0.5, 0.5])
    with pytest.raises(
        ConfigError, match=r"training\.learners, training\.runners: 101 processes are too many for 2 CPUs"
    ):
        cpu_share(101)


def using(runners: int, gpus: float = 0.0, runner_gpus: float = 0.0, learners: int = 1) -> Resources:
    return Resources(runners, num_envs=1, threads=1, gpus=gpus, runner_gpus=runner_gpus, learners=learners)


def machines(monkeypatch: pytest.MonkeyPatch, *resources: dict[str, float]) -> None:
    nodes = [{"Alive": True, "NodeID": str(place), "Resources": of_node} for place, of_node in enumerate(resources)]
    monkeypatch.setattr(ray, "nodes", lambda: nodes)
    monkeypatch.setattr(ray_cluster, "draining_nodes", set)
    monkeypatch.setattr(tune, "has_autoscaler", lambda: False)


def test_a_trial_requests_its_learner_and_its_runners_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    machines(monkeypatch, {"CPU": 8.0, "GPU": 1.0})
    learner, *runners = placement(using(runners=2, gpus=0.5, runner_gpus=0.25), 0.5).bundles
    assert (learner["CPU"], learner["GPU"]) == (0.5, 0.5)
    assert runners == [{"CPU": 0.5, "GPU": 0.25}] * 2
    (alone,) = placement(using(runners=0, gpus=0.5, runner_gpus=0.25), 1.0).bundles
    assert alone["GPU"] == 0.75, "the runner is in the learner's process"
    with pytest.raises(ConfigError, match=r"1\.5 GPUs requested in total, but Ray has 1"):
        placement(using(runners=2, gpus=1, runner_gpus=0.25), 0.5)


def test_each_learner_requests_its_resources(monkeypatch: pytest.MonkeyPatch) -> None:
    machines(monkeypatch, {"CPU": 2.0, "GPU": 2.0}, {"CPU": 2.0, "GPU": 1.0})
    bundles = placement(using(learners=3, runners=1, gpus=1), 1.0).bundles
    assert bundles == [{"CPU": 1.0, "GPU": 1.0}] * 3 + [{"CPU": 1.0}]
    with pytest.raises(ConfigError, match=r"training\.learners: expected 1, .* no GPU \(training\.gpus is 0\), got 2"):
        placement(using(runners=1, learners=2), 1.0)
    with pytest.raises(ConfigError, match=r"training\.learners with gpus: 4 GPUs requested in total, but Ray has 3"):
        placement(using(runners=1, learners=4, gpus=1), 0.5)
    with pytest.raises(ConfigError, match=r"2 learners need 1 CPUs and 1\.5 GPUs each"):
        placement(using(runners=1, learners=2, gpus=1.5), 1.0)


@pytest.mark.parametrize(
    ("cpus", "runners", "share"),
    [((0, 2, 2), 3, 1.0), ((0, 2, 2), 4, 0.66), ((1, 2), 3, 0.66), ((1.5, 0.5), 1, 0.75), ((0.5, 0.5, 0.5), 2, 0.5)],
)
def test_every_share_fits_on_a_node(
    cpus: tuple[float, ...], runners: int, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    machines(monkeypatch, *({"CPU": number} for number in cpus))
    assert cpu_share(1 + runners) == share
    assert len(placement(using(runners=runners), share).bundles) == runners + 1


def test_what_no_node_has_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray would wait for ever for a node to join."""
    machines(monkeypatch, {"CPU": 4.0}, {"GPU": 1.0})
    with pytest.raises(
        ConfigError, match=r"the learner needs 0\.5 CPUs and 1 GPUs, but .* 4 CPUs and 0 GPUs; 0 CPUs and 1"
    ):
        placement(using(runners=1, gpus=1), 0.5)
    machines(monkeypatch, {"CPU": 2.0, "GPU": 1.0}, {"CPU": 2.0, "GPU": 1.0})
    with pytest.raises(ConfigError, match=r"3 runners need 0\.5 CPUs and 0\.4 GPUs each"):
        placement(using(runners=3, gpus=0.75, runner_gpus=0.4), 0.5)


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
def test_other_errors_have_type_message_line_of_the_user_code_and_episode() -> None:
    fault = KeyError("ball\nand more")
    fault.add_note("in the episode with seed 7")
    error = training_error(through_processes(fault), "a", TRACE)
    line = next(n for n, text in enumerate(Path(__file__).read_text().splitlines(), 1) if "raise fault" in text)
    assert str(error).startswith("league a: training failed with KeyError: 'ball\\nand more' at ")
    assert str(error).endswith(f"{__file__}:{line} in the episode with seed 7; see the traceback in /runs/error.txt")


def test_an_error_without_message_or_line() -> None:
    assert str(training_error(MemoryError(), "a", TRACE)) == (
        "league a: training failed with MemoryError; see the traceback in /runs/error.txt"
    )
