from pathlib import Path

import pytest
import torch

from league.environments.building import interface
from tests.league.environments.counting import Counting
from tests.training.leagues import counting
from training.trial import build

LEAGUE = counting([4, 6], [1], train_batch_size=120, minibatch_size=60, epochs=1, runners=0)


@pytest.mark.usefixtures("ray_session")
def test_training_goes_on_exactly_where_its_checkpoint_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights, Adam's moments and the count of steps are the same; no reset of before is repeated."""
    seeds: list[int] = []
    reset = Counting.reset

    def recording(self: Counting, seed: int | None = None, options: None = None) -> None:
        seeds.append(seed)
        reset(self, seed, options)

    monkeypatch.setattr(Counting, "reset", recording)
    first = build(LEAGUE, interface(LEAGUE))
    first.train()
    first.train()
    first.save_to_path(str(tmp_path / "240"))
    learner = first.learner_group._learner
    weights = {name: value.clone() for name, value in learner.module["policy_0"].state_dict().items()}
    moments = learner.get_optimizer("policy_0").state_dict()["state"]
    first.stop()
    before = len(seeds)

    second = build(LEAGUE, interface(LEAGUE), tmp_path / "240")
    restored = second.learner_group._learner
    for name, value in restored.module["policy_0"].state_dict().items():
        assert torch.equal(value, weights[name])
    for index, state in restored.get_optimizer("policy_0").state_dict()["state"].items():
        assert all(torch.equal(state[key], moments[index][key]) for key in ("step", "exp_avg", "exp_avg_sq"))
    result = second.train()
    second.stop()
    assert result["num_env_steps_sampled_lifetime"] == 360
    assert len(seeds) > before > 0
    assert len(set(seeds)) == len(seeds)


@pytest.mark.usefixtures("ray_session")
def test_a_fault_of_the_environment_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Counting, action: int | None) -> None:
        raise ZeroDivisionError("the environment is broken")

    algorithm = build(LEAGUE, interface(LEAGUE))
    monkeypatch.setattr(Counting, "step", broken)
    try:
        with pytest.raises(ZeroDivisionError, match="the environment is broken"):
            algorithm.train()
    finally:
        algorithm.stop()
