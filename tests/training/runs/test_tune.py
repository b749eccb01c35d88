import pytest
import ray

from league.config.ppo import PPOConfig
from league.errors import ConfigError
from training.runs.tune import cpu_share, placement


@pytest.mark.usefixtures("ray_session")
def test_learner_and_runners_share_the_available_cpus() -> None:
    """Tests have two CPUs."""
    assert [cpu_share(0), cpu_share(1), cpu_share(3), cpu_share(1, at_once=2)] == pytest.approx([1.0, 1.0, 0.5, 0.5])
    with pytest.raises(ConfigError, match="100 runners are too many for 2 CPUs"):
        cpu_share(100)


@pytest.mark.usefixtures("ray_session")
def test_a_trial_requests_its_learner_here_and_its_runners_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray, "cluster_resources", lambda: {"CPU": 8.0, "GPU": 1.0})
    learner, *runners = placement(PPOConfig(runners=2, gpus=0.5, runner_gpus=0.25), 0.5).bundles
    assert (learner["CPU"], learner["GPU"]) == (0.5, 0.5)
    assert any(resource.startswith("node:") for resource in learner)
    assert runners == [{"CPU": 0.5, "GPU": 0.25}] * 2
    (alone,) = placement(PPOConfig(runners=0, gpus=0.5, runner_gpus=0.25), 1.0).bundles
    assert alone["GPU"] == 0.75, "the runner is in the learner's process"
    with pytest.raises(ConfigError, match=r"1\.5 GPUs requested in total, but Ray has 1"):
        placement(PPOConfig(runners=2, gpus=1, runner_gpus=0.25), 0.5)
