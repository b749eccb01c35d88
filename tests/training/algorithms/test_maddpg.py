"""MADDPG and DDPG as the pipeline trains, saves, resumes and exports them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.algorithms.algorithm import Algorithm

from league.config import LeagueConfig
from league.environments.building import interface
from league.errors import ConfigError, EnvironmentMismatch
from tests.training.environments import ROUNDS
from tests.training.leagues import maddpg
from training import parity
from training.algorithms.dispatch import algorithm_config, module_spec
from training.algorithms.maddpg import MADDPG
from training.export import export_policy
from training.sampling.closed import JOINT
from training.trial import build

OWN = {"a": ["player_0"], "b": ["player_1"]}
TWO = {"agents": 2}

pytestmark = pytest.mark.usefixtures("ray_session")


def begun(league: LeagueConfig, checkpoint: Path | None = None, steps: int = 0) -> MADDPG:
    algorithm = build(league, interface(league), checkpoint)
    assert isinstance(algorithm, MADDPG)
    algorithm.begin_anew(steps)
    return algorithm


def returns(algorithm: Algorithm, episodes: int = 200) -> float:
    """Mean return of an agent that acts greedily."""
    chunks = algorithm.env_runner.sample(num_episodes=episodes, explore=False, force_reset=True)
    return float(np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.t_started == 0]))


def turns() -> LeagueConfig:
    """A game with masks, whose players take turns."""
    return LeagueConfig.from_mapping(
        {
            "league": "turns",
            "environment": {"entry_point": "pettingzoo.classic.tictactoe_v3"},
            "training": {"algorithm": "maddpg", "runners": 0, "copies": 2, "hidden": [8]},
        }
    )


def state(algorithm: MADDPG) -> dict[str, Any]:
    """All that decides how training goes on."""
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


@pytest.mark.parametrize(("critic", "theta"), [("centralised", None), ("centralised", 0.15), ("own", None)])
def test_learns_to_cooperate_with_continuous_actions(critic: str, theta: float | None) -> None:
    algorithm = begun(maddpg("summing", {}, OWN, critic=critic, theta=theta))
    try:
        before = returns(algorithm)
        while algorithm.steps < 8_000:
            algorithm.train()
        after = returns(algorithm)
    finally:
        algorithm.stop()
    assert before < -0.4 * ROUNDS, "doing nothing misses by 2/3 on average"
    assert after > -0.05 * ROUNDS


def test_learns_opposed_tasks_with_choices() -> None:
    algorithm = begun(maddpg("discrete", TWO | {"opposed": True}, OWN))
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


def test_training_that_is_resumed_goes_on_exactly(tmp_path: Path) -> None:
    league = maddpg("summing", {"ends": 2}, OWN, theta=0.15, priorities={}, n_step=2)
    algorithm = begun(league)
    try:
        algorithm.train()
        steps = algorithm.steps
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        algorithm.begin_anew(steps)
        algorithm.train()
        expected = state(algorithm)
    finally:
        algorithm.stop()
    resumed = begun(league, tmp_path / "checkpoint", steps)
    try:
        resumed.train()
        found = state(resumed)
    finally:
        resumed.stop()
    assert found.keys() == expected.keys()
    assert {"target/a.critic/value.0.weight", "network/b/deviation", "replay/actions/a"} < found.keys()
    assert expected["updates"] > 20
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []


@pytest.mark.parametrize("name", ["numbers", "several", "discrete", "masked"])
def test_graphs_act_as_the_actors_do(name: str, tmp_path: Path) -> None:
    league = turns() if name == "masked" else maddpg(name, {} if name == "numbers" else TWO, {"shared": ["*"]})
    described = interface(league)
    torch.manual_seed(1)
    actor = module_spec(league.training, described).build()["shared"]
    with torch.no_grad():
        actor.head.weight.mul_(50)
    actor.exploration = 0.25
    met = parity.gather(league.environment, described, {"shared": actor}, seed=1)["shared"]
    export_policy(actor, described.of_policy("shared"), tmp_path / "shared.onnx")
    proof = parity.prove(tmp_path / "shared.onnx", "shared", actor, met, described.of_policy("shared").action)
    assert proof.observations >= 2048
    assert proof.mismatches == 0
    if name == "numbers":
        inputs, _ = parity.answer(actor, met[0])
        assert np.exp(inputs[:, 2:]) == pytest.approx(0.25), "who explores with a version has its noise"
        assert np.abs(inputs[:, :2]).max() <= 1


def test_opponents_are_refused() -> None:
    league = maddpg("discrete", TWO, OWN, opponents=["script:random"])
    with pytest.raises(ConfigError, match=r"training\.opponents.*what all agents saw and did"):
        algorithm_config(league, interface(league))


def test_turns_are_refused_before_anything_is_learned() -> None:
    algorithm = begun(turns())
    try:
        with pytest.raises(EnvironmentMismatch, match=r"league turns.*all agents act at once"):
            algorithm.train()
    finally:
        algorithm.stop()
