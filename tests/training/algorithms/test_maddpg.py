"""Training, saving, resuming and exporting MADDPG and DDPG."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.algorithm import Algorithm

from league.config.league import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import maddpg
from training.algorithms.maddpg import MADDPG
from training.algorithms.rllib_config import algorithm_config, module_spec
from training.export import parity
from training.export.onnx_export import export_policy
from training.runs.trial import build_algorithm
from training.sampling.closed_transitions import JOINT

OWN = {"a": ["player_0"], "b": ["player_1"]}
TWO = {"agents": 2}

pytestmark = pytest.mark.usefixtures("ray_session")


def start(league: LeagueConfig, checkpoint: Path | None = None, steps: int = 0) -> MADDPG:
    algorithm = build_algorithm(league, interface(league), checkpoint)
    assert isinstance(algorithm, MADDPG)
    algorithm.reset_episodes(steps)
    return algorithm


def returns(algorithm: Algorithm, episodes: int = 200) -> float:
    """Mean return of an agent with greedy actions."""
    chunks = algorithm.env_runner.sample(num_episodes=episodes, explore=False, force_reset=True)
    return float(np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.t_started == 0]))


def turn_based_league() -> LeagueConfig:
    """A turn-based game with action masks."""
    return LeagueConfig.from_mapping(
        {
            "league": "turns",
            "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
            "training": {"algorithm": "maddpg", "runners": 0, "num_envs": 2, "hidden": [8]},
        }
    )


def state(algorithm: MADDPG) -> dict[str, Any]:
    """The complete training state."""
    learner = algorithm.learner_group._learner
    tensors: dict[str, Any] = {
        f"{kind}/{name}/{key}": value
        for kind, networks in (("network", learner.networks), ("target", learner.targets))
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    for name, optimizer in learner._named_optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer/{name}/{index}/{key}": value for key, value in moments.items()}
    replay = algorithm.replays[JOINT]
    rows = {f"replay/{name}": torch.from_numpy(column) for name, column in replay.rows(np.arange(len(replay))).items()}
    counters = {"updates": learner.updates, "steps": algorithm.steps, "exploration": algorithm.exploration}
    return tensors | rows | {name: torch.tensor(value) for name, value in counters.items()}


@pytest.mark.parametrize(
    ("critic", "theta"),
    [
        ("centralised", 0.15),
        pytest.param("centralised", None, marks=pytest.mark.slow),
        pytest.param("own", None, marks=pytest.mark.slow),
    ],
)
def test_learns_to_cooperate_with_continuous_actions(critic: str, theta: float | None) -> None:
    algorithm = start(maddpg("summing", {}, OWN, critic=critic, theta=theta))
    try:
        initial = returns(algorithm)
        while algorithm.steps < 8_000:
            algorithm.train()
        after = returns(algorithm)
    finally:
        algorithm.stop()
    assert initial < -0.4 * ROUNDS, "a constant action has a mean squared error of 2/3"
    assert after > -0.05 * ROUNDS


@pytest.mark.slow
def test_learns_opposed_tasks_with_discrete_actions() -> None:
    algorithm = start(maddpg("discrete", TWO | {"opposed": True}, OWN))
    try:
        while algorithm.steps < 8_000:
            algorithm.train()
        chunks = algorithm.env_runner.sample(num_episodes=100, explore=False, force_reset=True)
    finally:
        algorithm.stop()
    means = {
        agent: np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.agent_id == agent])
        for agent in ("player_0", "player_1")
    }
    assert means["player_0"] > 0.9 * ROUNDS
    assert means["player_1"] > -0.1 * ROUNDS


def test_resumed_training_is_identical(tmp_path: Path) -> None:
    league = maddpg("summing", {"ends": 2}, OWN, theta=0.15, priorities={}, n_step=2)
    algorithm = start(league)
    try:
        algorithm.train()
        steps = algorithm.steps
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        algorithm.reset_episodes(steps)
        algorithm.train()
        expected = state(algorithm)
    finally:
        algorithm.stop()
    resumed = start(league, tmp_path / "checkpoint", steps)
    try:
        resumed.train()
        found = state(resumed)
    finally:
        resumed.stop()
    assert found.keys() == expected.keys()
    assert {"target/a.critic/value.0.weight", "network/b/deviation", "replay/actions/a"} < found.keys()
    assert expected["updates"] > 20
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


@pytest.mark.parametrize(
    "name", ["numbers", *(pytest.param(name, marks=pytest.mark.slow) for name in ("several", "discrete", "masked"))]
)
def test_graphs_equal_the_actors(name: str, tmp_path: Path) -> None:
    league = (
        turn_based_league() if name == "masked" else maddpg(name, {} if name == "numbers" else TWO, {"shared": ["*"]})
    )
    interface_of_league = interface(league)
    torch.manual_seed(1)
    actor = module_spec(league.training, interface_of_league).build()["shared"]
    with torch.no_grad():
        actor.head.weight.mul_(50)
    actor.exploration = 0.25
    met = parity.collect_observations(league.environment, interface_of_league, {"shared": actor}, seed=1)["shared"]
    export_policy(actor, interface_of_league.of_policy("shared"), tmp_path / "shared.onnx")
    proof = parity.check_parity(
        tmp_path / "shared.onnx", "shared", actor, met, interface_of_league.of_policy("shared").action
    )
    assert proof.observations >= 2048
    assert proof.mismatches == 0
    if name == "numbers":
        inputs, _ = parity.module_outputs(actor, met[0])
        assert np.exp(inputs[:, 2:]) == pytest.approx(0.25), "exploration noise is exported"
        assert np.abs(inputs[:, :2]).max() <= 1


def test_opponents_are_rejected() -> None:
    league = maddpg("discrete", TWO, OWN, opponents=["script:random"])
    with pytest.raises(ConfigError, match=r"training\.opponents.*observations and actions of all agents"):
        algorithm_config(league, interface(league))


def test_turn_based_games_are_rejected_before_learning() -> None:
    algorithm = start(turn_based_league())
    try:
        with pytest.raises(EnvironmentMismatch, match=r"league turns.*all agents act at once"):
            algorithm.train()
    finally:
        algorithm.stop()
