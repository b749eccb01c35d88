"""What DQN, QMIX and MADDPG do as algorithms: they learn, continue from a checkpoint, and export what acts."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from ray.rllib.utils.metrics import ENV_RUNNER_RESULTS, EPISODE_MODULE_RETURN_MEAN, LEARNER_RESULTS

from benchmarks.training import two_step
from league.config.league import LeagueConfig
from league.config.schedules import ScheduleProgress
from league.environments.building import interface
from league.errors import ConfigError
from league.policies.onnx import OnnxPolicy
from tests.support.algorithms import running
from tests.support.environments.training_environments import ROUNDS
from tests.support.leagues.training_leagues import maddpg, solvable_by_dqn
from tests.support.leagues.training_leagues import qmix_league as qmix
from training.algorithms import off_policy
from training.algorithms.metrics import OFF_POLICY_METRICS, metric_names, training_metrics
from training.algorithms.off_policy import starts_with_empty_replay
from training.algorithms.rllib_config import algorithm_config, module_spec
from training.export import parity
from training.export.onnx_export import export_policy, graph_tensors, state_names
from training.learners.off_policy import ReplayBatch
from training.modules.policy_module import MASKED_LOGIT, PREVIOUS_ACTION
from training.modules.qmix import MonotonicMixer
from training.replay_buffer import ReplayBuffer
from training.sampling.closed_transitions import JOINT, PRESENT, REWARDS, STATE

pytestmark = pytest.mark.usefixtures("ray_session")
slow = pytest.mark.slow
dqn = solvable_by_dqn

OWN = {"a": ["player_0"], "b": ["player_1"]}
OPPOSED: dict[str, Any] = {"agents": 2, "opposed": True}
MEMORY: dict[str, Any] = {"recurrence": {"width": 16, "sequence": 3}, "batch_size": 32, "hidden": [16]}
ALL_EXTENSIONS: dict[str, Any] = {
    "n_step": 3,
    "priorities": {},
    "noisy": True,
    "distributional": {"low": -1, "high": 5},
}
TEAMS: dict[str, Any] = {"groups": {"one": ["player_0"], "other": ["player_1", "player_2"]}}
TASK = {"shared": 0.9 * ROUNDS}
EACH = dict.fromkeys(OWN, 0.85 * ROUNDS)
OPPOSITES = {"a": 0.85 * ROUNDS, "b": -0.15 * ROUNDS}


@pytest.fixture
def short_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(off_policy, "ITERATION_STEPS", 256)


def learns(league: LeagueConfig, target: dict[str, float], limit: int) -> bool:
    """Whether the mean return of each policy reaches its target within a number of updates; training ends then."""
    with running(league) as algorithm:
        for _ in range(limit):
            means = algorithm.train()[ENV_RUNNER_RESULTS].get(EPISODE_MODULE_RETURN_MEAN, {})
            if target.keys() <= means.keys() and all(means[policy] > value for policy, value in target.items()):
                return True
    return False


@slow
@pytest.mark.parametrize(
    ("league", "target", "updates"),
    [
        pytest.param(dqn("discrete"), TASK, 9, id="dqn"),
        pytest.param(dqn("discrete", double=False, dueling=False), TASK, 9, id="dqn, single"),
        pytest.param(dqn("discrete", **ALL_EXTENSIONS), TASK, 9, id="dqn, all extensions"),
        pytest.param(dqn("discrete", target_every=1, target_rate=0.02), TASK, 9, id="dqn, Polyak"),
        pytest.param(dqn("discrete", OPPOSED, OWN), OPPOSITES, 10, id="dqn, opposed tasks"),
        pytest.param(qmix("discrete", {"agents": 2}, OWN), EACH, 14, id="qmix"),
        pytest.param(qmix("discrete", {"agents": 2}, OWN, mixer="vdn"), EACH, 14, id="vdn"),
        pytest.param(qmix("discrete", {"agents": 2}, OWN, mixer="none"), EACH, 14, id="independent values"),
        pytest.param(
            qmix("discrete", OPPOSED | {"agents": 3}, {"a": ["player_0"], "b": ["*"]}, **TEAMS),
            OPPOSITES,
            14,
            id="qmix, competing teams",
        ),
    ],
)
def test_it_learns(league: LeagueConfig, target: dict[str, float], updates: int) -> None:
    assert learns(league, target, updates)


@slow
@pytest.mark.parametrize("algorithm", [dqn, qmix])
def test_remembering_requires_recurrence(algorithm: Callable[..., LeagueConfig]) -> None:
    settings = {"gamma": 0.99, "num_envs": 8, "exploration": {"steps": 8000}}
    assert learns(algorithm("remembering", **settings, **MEMORY), {"shared": 0.8}, 14)
    assert not learns(algorithm("remembering", **settings), {"shared": 0.5}, 14)


HALF: dict[str, Any] = {"exploration": {"initial": 0.5, "final": 0.5}}
VDN: dict[str, Any] = {"mixer": "vdn"} | HALF


@pytest.mark.parametrize(
    ("league", "updates"),
    [
        pytest.param(dqn("masked", n_step=3, gamma=0.5, **HALF), 3, id="dqn, three steps"),
        pytest.param(dqn("masked", **HALF), 11, marks=slow, id="dqn"),
        pytest.param(qmix("masked", n_step=3, gamma=0.5, **VDN), 3, id="vdn, three steps"),
        pytest.param(qmix("masked", **VDN), 11, marks=slow, id="vdn"),
        pytest.param(qmix("masked", double=False, **VDN), 11, marks=slow, id="vdn, single"),
        pytest.param(qmix("masked", gamma=0.5, **VDN, **MEMORY), 11, marks=slow, id="vdn, recurrent"),
    ],
)
def test_values_bootstrap_truncation_and_ignore_illegal_actions(league: LeagueConfig, updates: int) -> None:
    """The value of the state is that of an endless episode, as truncation is bootstrapped. The large value of an
    illegal action is ignored.
    """
    with running(league) as algorithm:
        algorithm.train()
        learner = algorithm.learner_group._learner
        module = learner.module["shared"]
        for network in (module, learner.targets["shared"]):
            with torch.no_grad():
                (network.advantages if league.training.algorithm == "dqn" else network.head).bias[1] += 1000.0
        for _ in range(updates - 1):
            algorithm.train()
    observation = {"observation": torch.ones(1, 1), "action_mask": torch.tensor([[1, 0, 1]])}
    state = {key: torch.as_tensor(value)[None] for key, value in module.get_initial_state().items()}
    values = module.forward_inference({"obs": observation, "state_in": state})["action_dist_inputs"].numpy()[0]
    assert values[1] == MASKED_LOGIT
    np.testing.assert_allclose(values[[0, 2]], 1 / (1 - league.training.gamma), rtol=0.1)


SOON: dict[str, Any] = {"learning_starts": 64, "replay_capacity": 200}
"""Learning starts in the first iteration, and rows are overwritten in the second one."""


@pytest.mark.usefixtures("short_iterations")
@pytest.mark.parametrize(
    "league",
    [
        pytest.param(dqn("discrete", **SOON, **ALL_EXTENSIONS), id="dqn, all extensions"),
        pytest.param(dqn("discrete", **SOON, **MEMORY), marks=slow, id="dqn, recurrent"),
        pytest.param(qmix("discrete", {"agents": 2}, **SOON, normalize_observations=True), id="qmix, normalised"),
        pytest.param(qmix("discrete", {"agents": 2}, **SOON, **MEMORY), marks=slow, id="qmix, recurrent"),
        pytest.param(maddpg("summing", {"ends": 2}, OWN, theta=0.15, priorities={}, n_step=2, **SOON), id="maddpg"),
    ],
)
def test_a_restored_algorithm_continues_identically(league: LeagueConfig, tmp_path: Path) -> None:
    """Networks, targets, optimizers, replay and counters, compared with an algorithm that continues."""

    def state_after(algorithm: Any) -> dict[str, Any]:
        algorithm.reset_episodes(2048)
        for _ in range(2):
            algorithm.train()
        learner = algorithm._learner
        state: dict[str, Any] = {"updates": learner.updates, "steps": algorithm.steps, "noise": algorithm.exploration}
        for kind, networks in (("network", learner.networks), ("target", learner.targets)):
            for name, network in networks.items():
                state |= {f"{kind} {name} {key}": value.numpy().copy() for key, value in network.state_dict().items()}
        for name, optimizer in learner._named_optimizers.items():
            for index, moments in optimizer.state_dict()["state"].items():
                state |= {f"{name} {index} {key}": torch.as_tensor(value).numpy() for key, value in moments.items()}
        for name, replay in algorithm.replays.items():
            state |= {f"replay {name} {key}": column for key, column in replay.sample(64).rows.items()}
        return state

    with running(league) as algorithm:
        for _ in range(2):
            algorithm.train()
        algorithm.save_to_path(str(tmp_path / "checkpoint"))
        expected = state_after(algorithm)
    assert expected["updates"] > 20
    torch.manual_seed(77)
    with running(league, tmp_path / "checkpoint") as restored:
        state = state_after(restored)
    assert state.keys() == expected.keys()
    assert [name for name, value in expected.items() if not np.array_equal(state[name], value)] == []


@pytest.mark.usefixtures("short_iterations")
def test_a_buffer_that_is_not_saved_or_has_another_capacity_is_empty_after_restoring(
    tmp_path: Path, subtests: pytest.Subtests
) -> None:
    league, checkpoint = dqn("discrete"), tmp_path / "checkpoint"
    with running(league) as algorithm:
        algorithm.train()
        algorithm.save_to_path(str(checkpoint))
    assert not starts_with_empty_replay(league.training, checkpoint)
    for settings in ({"replay_in_checkpoint": False}, {"replay_capacity": 5000}):
        changed = league.with_training(**settings)
        with subtests.test(**settings), running(changed, checkpoint) as restored:
            assert starts_with_empty_replay(changed.training, checkpoint)
            assert (len(restored.replays["shared"]), restored.steps) == (0, 256)


@pytest.mark.parametrize(
    "league",
    [
        pytest.param(dqn("masked"), marks=slow, id="dqn"),
        pytest.param(dqn("masked", **ALL_EXTENSIONS), id="dqn, all extensions"),
        pytest.param(dqn("masked", **MEMORY), marks=slow, id="dqn, recurrent"),
        pytest.param(qmix("masked"), marks=slow, id="qmix"),
        pytest.param(qmix("masked", **MEMORY), id="qmix, recurrent"),
        pytest.param(maddpg("numbers", {}, {"shared": ["*"]}), id="maddpg, numbers"),
        pytest.param(maddpg("several", {"agents": 2}, {"shared": ["*"]}), marks=slow, id="maddpg, several"),
        pytest.param(maddpg("discrete", {"agents": 2}, {"shared": ["*"]}), marks=slow, id="maddpg, discrete"),
        pytest.param(maddpg("masked", {}, {"shared": ["*"]}), marks=slow, id="maddpg, masked"),
    ],
)
def test_the_graph_equals_the_module_and_depends_on_its_own_observation_only(
    league: LeagueConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parity, "EXPORTED", replace(parity.EXPORTED, observations=400))
    game, masked = interface(league), league.league == "masked"
    spaces, graph = game.of_policy("shared"), tmp_path / "shared.onnx"
    torch.manual_seed(1)
    modules = module_spec(league.training, game).build()
    assert set(modules.keys()) == {"shared"}, "mixers and critics are not exported"
    module = modules["shared"]
    if league.training.algorithm == "maddpg":
        with torch.no_grad():
            module.head.weight.mul_(50)
        module.exploration = 0.25
    inputs, _, state = graph_tensors(module, spaces)
    names = {tensor.name for tensor in inputs} - {tensor.name for tensor in state}
    assert names == {"observation"} | ({"action_mask"} if masked else set())
    export_policy(module, spaces, graph)
    observed = parity.collect_observations(league.environment, game, {"shared": module}, seed=1)["shared"]
    proof = parity.check_parity(graph, "shared", module, observed, spaces.action)
    assert (proof.mismatches, proof.max_difference < 1e-4, proof.observations >= 400) == (0, True, True)
    if masked:
        first = observed[0]
        states = dict(zip(state_names(first.state), first.state.values(), strict=True)) or None
        outputs = OnnxPolicy(graph).distribution(first.observations, state=states)
        assert (outputs.dist_inputs[:, 1] == np.float32(MASKED_LOGIT)).all()
        assert (outputs.actions != 1).all()
    if league.league == "numbers":
        dist_inputs, _ = parity.module_outputs(module, observed[0])
        assert np.exp(dist_inputs[:, 2:]) == pytest.approx(0.25), "exploration noise is exported"
        assert np.abs(dist_inputs[:, :2]).max() <= 1


@pytest.mark.parametrize(
    ("league", "message"),
    [
        (dqn("numbers"), r"policies\.shared: dqn needs Discrete actions, got .*: train it with"),
        (qmix("numbers"), r"training\.groups\.team: qmix needs Discrete actions, but player_0 has"),
        (
            maddpg("discrete", {"agents": 2}, OWN, opponents=["script:random"]),
            r"training\.opponents.*observations and actions of all agents",
        ),
    ],
    ids=["dqn", "qmix", "maddpg"],
)
def test_what_it_cannot_learn_is_rejected(league: LeagueConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        algorithm_config(league, interface(league))


@pytest.mark.usefixtures("short_iterations")
def test_rows_after_the_end_of_an_episode_do_not_count() -> None:
    """Sequences of five steps in episodes of four: each sequence ends with a repeated row."""
    sequence = ROUNDS + 1
    league = dqn("discrete", recurrence={"width": 4, "sequence": sequence}, batch_size=4)
    with running(league) as algorithm:
        algorithm.train()
        learner, sample = algorithm.learner_group._learner, algorithm.draw_sample(algorithm.replays["shared"])
        batch = learner.batch(sample)
        changed_rows = {**batch.rows, REWARDS: torch.where(batch.weights > 0, batch.rows[REWARDS], 1e6)}
        assert (batch.weights.reshape(-1, sequence)[:, -1] == 0).all()
        kept, changed = (
            learner.losses({"shared": ReplayBatch(rows, batch.weights)}, ["shared"])["shared"]
            for rows in (batch.rows, changed_rows)
        )
    assert kept.total == changed.total > 0
    assert kept.statistics["error"] == changed.statistics["error"]


@pytest.mark.usefixtures("short_iterations")
def test_exploration_follows_the_steps_and_the_correction_by_priorities_the_budget(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps include those of parent versions, the budget is the run's own."""
    league = dqn("discrete", priorities={"beta": 0.4}, exploration={"steps": 512, "final": 0.1})
    betas: list[float] = []
    sample = ReplayBuffer.sample

    def record_beta(self: ReplayBuffer, *arguments: Any, beta: float = 1.0, **options: Any) -> Any:
        betas.append(beta)
        return sample(self, *arguments, beta=beta, **options)

    monkeypatch.setattr(ReplayBuffer, "sample", record_beta)
    with running(league) as algorithm:
        results = [algorithm.train() for _ in range(3)]
        assert [result["exploration"] for result in results] == pytest.approx([0.55, 0.1, 0.1])
        assert set(betas) == {0.4}
        algorithm.progress = ScheduleProgress(algorithm.steps, budget=0.25)
        algorithm.draw_sample(algorithm.replays["shared"])
    assert algorithm.steps == 768
    assert betas[-1] == pytest.approx(0.55)
    curves = training_metrics(results[-1], interface(league), OFF_POLICY_METRICS)
    assert metric_names(interface(league), OFF_POLICY_METRICS) <= curves.keys()


@pytest.mark.parametrize(
    ("critic", "theta", "steps"),
    [
        ("centralised", 0.15, 4_000),
        pytest.param("centralised", None, 8_000, marks=slow),
        pytest.param("own", None, 8_000, marks=slow),
    ],
)
def test_maddpg_learns_to_cooperate_with_continuous_actions(critic: str, theta: float | None, steps: int) -> None:
    def returns(algorithm: Any) -> float:
        """Mean return of an agent with greedy actions."""
        chunks = algorithm.env_runner.sample(num_episodes=200, explore=False, force_reset=True)
        return float(np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.t_started == 0]))

    with running(maddpg("summing", {}, OWN, critic=critic, theta=theta)) as algorithm:
        initial = returns(algorithm)
        while algorithm.steps < steps:
            algorithm.train()
        after = returns(algorithm)
    assert initial < -0.4 * ROUNDS, "a constant action has a mean squared error of 2/3"
    assert after > -0.05 * ROUNDS


@slow
def test_maddpg_learns_opposed_tasks_with_discrete_actions() -> None:
    with running(maddpg("discrete", OPPOSED, OWN)) as algorithm:
        while algorithm.steps < 8_000:
            algorithm.train()
        chunks = algorithm.env_runner.sample(num_episodes=100, explore=False, force_reset=True)
    means = {
        agent: np.mean([chunk.get_return() for chunk in chunks if chunk.is_done and chunk.agent_id == agent])
        for agent in ("player_0", "player_1")
    }
    assert means["player_0"] > 0.9 * ROUNDS
    assert means["player_1"] > -0.1 * ROUNDS


@slow
def test_qmix_solves_the_two_step_game_exactly() -> None:
    """One seed of `benchmarks.learning two_step_game`."""
    learned = two_step.learn("qmix", seed=0)
    assert learned.returned == 8
    assert learned.error(gamma=0.99) < 0.1


@slow
@pytest.mark.parametrize("mixer", ["vdn", "none"])
def test_additive_and_independent_values_choose_the_safe_game(mixer: str) -> None:
    """Negative controls: additive and independent values do not choose the game with the return 8."""
    learned = two_step.learn(mixer, seed=0, steps=12_000)
    assert learned.returned == 7
    assert learned.error(gamma=0.99) > 1


@pytest.mark.usefixtures("short_iterations")
def test_the_recurrent_state_has_the_drawn_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    """While exploring, drawn actions differ from the greedy ones."""
    drawn, stored = [], []
    with running(qmix("discrete", exploration={"initial": 1.0, "final": 1.0}, num_envs=4, **MEMORY)) as algorithm:
        recorder = algorithm.env_runner_group.local_env_runner._play.recorder
        act = recorder.act

        def record(policy: str, raw: NDArray, log_p: NDArray, dist_inputs: NDArray, state: Any) -> None:
            drawn.append(raw.tolist())
            stored.append(state[PREVIOUS_ACTION].ravel().tolist())
            act(policy, raw, log_p, dist_inputs, state)

        monkeypatch.setattr(recorder, "act", record)
        algorithm.train()
    assert len({tuple(row) for row in drawn}) > 10
    for step, rows in enumerate(stored):
        assert rows == ([0.0] * 4 if step % ROUNDS == 0 else [action + 1.0 for action in drawn[step - 1]])


@pytest.mark.usefixtures("short_iterations")
def test_frozen_policies_do_not_change() -> None:
    league = qmix("discrete", {"agents": 2}, OWN, policies_to_train=["b"], learning_starts=64)
    with running(league) as algorithm:
        networks = algorithm.learner_group._learner.networks
        initial = {name: [p.detach().clone() for p in net.parameters()] for name, net in networks.items()}
        algorithm.train()
        changed = {
            name: any(not torch.equal(a, b) for a, b in zip(initial[name], net.parameters(), strict=True))
            for name, net in networks.items()
        }
    assert changed == {"a": False, "b": True, "mixer/team": True}


@pytest.mark.usefixtures("short_iterations")
@pytest.mark.parametrize("settings", [{}, MEMORY], ids=["feed-forward", "memory"])
def test_agents_of_a_team_are_trained_on_while_they_are_present(settings: dict[str, Any]) -> None:
    groups = {f"team_{i}": [f"agent_{i}"] for i in range(3)}
    document = qmix("discrete", groups=groups, learning_starts=32, **settings).model_dump(mode="json", by_alias=True)
    document["environment"]["entry_point"] = "tests.support.environments.simultaneous:meeting"
    document["environment"]["kwargs"] = {"arrives": [0, 2, 0], "leaves": [5, 6, 3], "truncated": [1]}
    document["policies"] = {f"policy_{i}": [f"agent_{i}"] for i in range(3)}
    with running(LeagueConfig.from_mapping(document)) as algorithm:
        result = algorithm.train()
        rows = algorithm.replays[JOINT].sample(500).rows
    assert 0 < rows[f"{PRESENT}/policy_1"].mean() < 1
    assert np.isfinite(result[LEARNER_RESULTS][JOINT]["loss"])


@pytest.mark.usefixtures("short_iterations")
def test_the_mixer_uses_the_state_of_rllib_infos() -> None:
    config = LeagueConfig.load("policy_league/configs/two_step_game.yaml")
    document = config.model_dump(mode="json", by_alias=True)
    document["environment"] |= {
        "entry_point": "tests.support.environments.rllib_two_step:multi_agent_env",
        "wrappers": [],
    }
    document["policies"] = {"first": ["agent_0"], "second": ["agent_1"]}
    with running(LeagueConfig.from_mapping(document)) as algorithm:
        algorithm.train()
        mixer = algorithm.learner_group._learner.networks["mixer/team"]
        assert isinstance(mixer, MonotonicMixer)
        assert mixer.first_weights.in_features == 3
        assert algorithm.replays[JOINT].sample(10).rows[STATE].shape == (10, 3)
