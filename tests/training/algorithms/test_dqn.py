"""DQN in this process: it learns, with each of its parts, and continues exactly from its checkpoint."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from league.config.schedules import ScheduleProgress
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import solvable, solvable_by_dqn
from tests.support.off_policy import build, learns, train
from training.algorithms.off_policy import OffPolicy, starts_with_empty_replay
from training.algorithms.rllib_config import algorithm_config, module_spec
from training.export import parity
from training.export.onnx_export import export_policy
from training.learners import dqn as learning
from training.learners.off_policy import ReplayBatch, next_actions
from training.modules.policy_module import MASKED_LOGIT
from training.replay_buffer import ReplayBuffer
from training.sampling.closed_transitions import REWARDS, TERMINATED, TRUNCATED, PolicyTransitions

pytestmark = pytest.mark.usefixtures("ray_session")
RETURN = 1 / (1 - 0.9)
MEMORY = {"recurrence": {"width": 16, "sequence": 3}, "batch_size": 32}
ALL_EXTENSIONS = {"n_step": 3, "priorities": {}, "noisy": True, "distributional": {"low": -1, "high": 5}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [{}, {"double": False, "dueling": False}, ALL_EXTENSIONS, {"target_every": 1, "target_rate": 0.02}],
    ids=["plain", "single", "all extensions", "Polyak"],
)
def test_dqn_learns(settings: dict[str, Any]) -> None:
    assert learns(solvable_by_dqn("discrete", **settings), {"shared": 0.9 * ROUNDS}, 9)


@pytest.mark.slow
def test_independent_policies_learn_opposed_tasks() -> None:
    league = solvable_by_dqn("discrete", {"agents": 2, "opposed": True}, {"a": ["player_0"], "b": ["player_1"]})
    assert learns(league, {"a": 0.85 * ROUNDS, "b": -0.15 * ROUNDS}, 10)


@pytest.mark.slow
def test_remembering_requires_recurrence() -> None:
    settings = {"gamma": 0.99, "num_envs": 8, "exploration": {"steps": 8000}}
    assert learns(solvable_by_dqn("remembering", **settings, **MEMORY), {"shared": 0.8}, 14)
    assert not learns(solvable_by_dqn("remembering", **settings), {"shared": 0.5}, 14)


def test_rows_after_the_end_of_an_episode_do_not_count() -> None:
    """Sequences of five steps in episodes of four: each sequence ends with a repeated row."""
    sequence = ROUNDS + 1
    league = solvable_by_dqn("discrete", recurrence={"width": 4, "sequence": sequence}, batch_size=4)

    def losses(algorithm: OffPolicy, _: Any) -> tuple[Any, Any]:
        learner, sample = algorithm.learner_group._learner, algorithm.draw_sample(algorithm.replays["shared"])
        batch = learner.batch(sample)
        changed = {**batch.rows, REWARDS: torch.where(batch.weights > 0, batch.rows[REWARDS], 1e6)}
        assert (batch.weights.reshape(-1, sequence)[:, -1] == 0).all()
        return tuple(
            learner.losses({"shared": ReplayBatch(rows, batch.weights)}, ["shared"])["shared"]
            for rows in (batch.rows, changed)
        )

    kept, changed = train(league, 2, losses)
    assert kept.total == changed.total > 0
    assert kept.statistics["error"] == changed.statistics["error"]


def values_of(algorithm: OffPolicy, _: Any) -> NDArray:
    """The masked values of the actions in the only state."""
    module = algorithm.learner_group._learner.module["shared"]
    observation = {"observation": torch.ones(1, 1), "action_mask": torch.tensor([[1, 0, 1]])}
    return module.forward_inference({"obs": observation})["action_dist_inputs"].numpy()[0]


def check_values(n_step: int = 1) -> None:
    """The value of the state is that of an endless episode, as truncation is bootstrapped. The large value of an
    illegal action is ignored.
    """
    league = solvable_by_dqn("masked", gamma=0.9, n_step=n_step, exploration={"initial": 0.5, "final": 0.5})

    def inspect_algorithm(algorithm: OffPolicy, _: Any) -> NDArray:
        learner = algorithm.learner_group._learner
        for network in (learner.module["shared"], learner.targets["shared"]):
            with torch.no_grad():
                network.advantages.bias[1] += 1000.0
        for _ in range(8):
            result = algorithm.train()
        return values_of(algorithm, result)

    found = train(league, 1, inspect_algorithm)
    assert found[1] == MASKED_LOGIT
    np.testing.assert_allclose(found[[0, 2]], RETURN, rtol=0.1)


@pytest.mark.parametrize("n_step", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_values_bootstrap_truncation_and_ignore_illegal_actions(n_step: int) -> None:
    check_values(n_step)


@pytest.mark.slow
def test_the_check_detects_truncation_treated_as_termination(monkeypatch: pytest.MonkeyPatch) -> None:
    cut = PolicyTransitions.cut

    def as_terminated(self: PolicyTransitions) -> Any:
        blocks = cut(self)
        for block in blocks.values():
            block.rows[TERMINATED] = block.rows[TERMINATED] | block.rows[TRUNCATED]
        return blocks

    monkeypatch.setattr(PolicyTransitions, "cut", as_terminated)
    with pytest.raises(AssertionError):
        check_values()


@pytest.mark.slow
def test_the_check_detects_targets_without_a_mask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "next_actions", lambda online, target, _: next_actions(online, target, None))
    with pytest.raises(AssertionError):
        check_values()


@pytest.mark.parametrize(
    "settings", [ALL_EXTENSIONS, pytest.param(MEMORY, marks=pytest.mark.slow)], ids=["all extensions", "recurrent"]
)
def test_a_restored_algorithm_continues_identically(settings: dict[str, Any], tmp_path: Path) -> None:
    """Compares an algorithm that continues after its checkpoint with a restored one: weights, targets and buffer."""
    league = solvable_by_dqn("discrete", **settings, replay_capacity=900)

    def state_after(algorithm: OffPolicy) -> list[NDArray]:
        algorithm.reset_episodes(2048)
        for _ in range(2):
            algorithm.train()
        learner = algorithm.learner_group._learner
        states = [learner.module["shared"].state_dict(), learner.targets["shared"].state_dict()]
        kept = algorithm.replays["shared"].sample(64).rows.values()
        return [tensor.numpy().copy() for state in states for tensor in state.values()] + list(kept)

    def save(algorithm: OffPolicy, _: Any) -> list[NDArray]:
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        return state_after(algorithm)

    expected = train(league, 2, save)
    torch.manual_seed(77)
    restored = build(league)
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        found = state_after(restored)
    finally:
        restored.stop()
    for before, now in zip(expected, found, strict=True):
        np.testing.assert_array_equal(before, now)


@pytest.mark.parametrize("settings", [{"replay_in_checkpoint": False}, {"replay_capacity": 5000}])
def test_a_buffer_that_is_not_saved_or_has_another_capacity_is_empty_after_restoring(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    league = solvable_by_dqn("discrete")
    train(league, 1, lambda algorithm, _: algorithm.save_to_path(str(tmp_path / "checkpoint")))
    assert not starts_with_empty_replay(league.training, tmp_path / "checkpoint")
    assert starts_with_empty_replay(league.with_training(**settings).training, tmp_path / "checkpoint")
    restored = build(league.with_training(**settings))
    try:
        restored.restore_from_path(str(tmp_path / "checkpoint"))
        assert (len(restored.replays["shared"]), restored.steps) == (0, 1024)
    finally:
        restored.stop()


def test_exploration_follows_the_steps_and_the_correction_by_priorities_the_budget(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps include those of parent versions, the budget is the run's own."""
    league = solvable_by_dqn("discrete", priorities={"beta": 0.4}, exploration={"steps": 2048, "final": 0.1})
    betas: list[float] = []
    sample = ReplayBuffer.sample

    def record_beta(self: ReplayBuffer, *arguments: Any, beta: float = 1.0, **options: Any) -> Any:
        betas.append(beta)
        return sample(self, *arguments, beta=beta, **options)

    def inspect_algorithm(algorithm: OffPolicy, result: dict[str, Any]) -> tuple[int, float, float]:
        algorithm.progress = ScheduleProgress(algorithm.steps, budget=0.25)
        algorithm.draw_sample(algorithm.replays["shared"])
        return algorithm.steps, result["exploration"], betas[-1]

    monkeypatch.setattr(ReplayBuffer, "sample", record_beta)
    assert train(league, 1, inspect_algorithm) == (1024, pytest.approx(0.55), pytest.approx(0.55))
    assert betas[0] == 0.4
    assert train(league, 3, inspect_algorithm) == (3072, pytest.approx(0.1), pytest.approx(0.55))


@pytest.mark.parametrize("settings", [{}, ALL_EXTENSIONS, MEMORY], ids=["plain", "all extensions", "recurrent"])
def test_the_graph_equals_the_module_without_noise(settings: dict[str, Any], tmp_path: Path) -> None:
    league = solvable_by_dqn("masked", **settings)
    interface_of_league = interface(league)
    module = module_spec(league.training, interface_of_league).build()["shared"]
    export_policy(module, interface_of_league.of_policy("shared"), tmp_path / "shared.onnx")
    observed = parity.collect_observations(league.environment, interface_of_league, {"shared": module}, seed=1)[
        "shared"
    ]
    proof = parity.check_parity(
        tmp_path / "shared.onnx", "shared", module, observed, interface_of_league.of_policy("shared").action
    )
    assert (proof.mismatches, proof.max_difference < 1e-5) == (0, True)
    graph = OnnxPolicy(tmp_path / "shared.onnx").distribution(observed[0].observations)
    assert (graph.dist_inputs[:, 1] == np.float32(MASKED_LOGIT)).all()
    assert (graph.actions != 1).all()


def test_actions_without_values_are_rejected() -> None:
    league = solvable("numbers")
    with pytest.raises(ConfigError, match=r"policies\.shared: dqn needs Discrete actions, got .*: train it with"):
        algorithm_config(solvable_by_dqn("numbers"), interface(league))
