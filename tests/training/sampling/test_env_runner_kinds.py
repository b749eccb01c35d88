"""The runner in each kind of environment and with each kind of policy: its chunks equal the outputs of the module."""

import logging
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode
from ray.rllib.utils.metrics import (
    EPISODE_AGENT_RETURN_MEAN,
    EPISODE_LEN_MEAN,
    EPISODE_MODULE_RETURN_MEAN,
    EPISODE_RETURN_MEAN,
    NUM_ENV_STEPS_SAMPLED,
    NUM_EPISODES,
    NUM_MODULE_STEPS_SAMPLED,
)

from league.config.league import LeagueConfig
from league.environments import lockstep
from league.environments.building import interface
from league.errors import ConfigError, InvalidReward
from league.policies.actions import to_environment
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces.conversion import to_gymnasium
from tests.support.environments.cases import CASES, Case
from tests.support.environments.simultaneous import Simultaneous
from tests.support.leagues import registries
from tests.support.leagues.training_leagues import counting, solvable, tictactoe
from tests.support.policies.graphs import masked_mlp
from training.algorithms.rllib_config import algorithm_config
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.opponents import Opponents
from training.sampling.play_metrics import CRASHES, EPISODE_AGENT_LEN_MEAN, EPISODE_MODULE_LEN_MEAN
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import GAMES, OPPONENTS

MEETING = "tests.support.environments.simultaneous:meeting"
RLLIB_MEETING = "tests.support.environments.simultaneous:rllib_meeting"


def simultaneous(
    entry_point: str, agents: int = 2, kwargs: dict[str, Any] | None = None, **training: Any
) -> LeagueConfig:
    """Each agent has its own policy."""
    return LeagueConfig.from_mapping(
        {
            "league": "together",
            "environment": {"entry_point": entry_point, "kwargs": kwargs or {}},
            "policies": {f"policy_{i}": [f"agent_{i}"] for i in range(agents)},
            "training": {"runners": 0, "num_envs": 3, "hidden": [8], "seed": 5} | training,
        }
    )


def spread(**training: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "spread",
            "environment": {"entry_point": "mpe2.simple_spread_v3", "kwargs": {"max_cycles": 6}},
            "training": {"runners": 0, "num_envs": 2, "hidden": [8], "seed": 5} | training,
        }
    )


def leduc(**training: Any) -> LeagueConfig:
    return LeagueConfig.from_mapping(
        {
            "league": "leduc",
            "environment": {"entry_point": "pettingzoo.classic.leduc_holdem_v4"},
            "training": {"runners": 0, "num_envs": 3, "hidden": [8], "seed": 5} | training,
        }
    )


def runner_of(league: LeagueConfig, storage: Storage | None = None) -> BatchedEnvRunner:
    torch.manual_seed(0)
    return BatchedEnvRunner(algorithm_config(league, interface(league), storage), worker_index=0)


def columns(chunk: SingleAgentEpisode) -> dict[str, Any]:
    state = chunk.extra_model_outputs.get(Columns.STATE_IN)
    return {
        "agent": chunk.agent_id,
        "started": chunk.t_started,
        "done": (chunk.is_terminated, chunk.is_truncated),
        "observations": {name: array.tolist() for name, array in chunk.observations.data.items()},
        "actions": chunk.actions.data.tolist(),
        "rewards": chunk.rewards.data.tolist(),
        "log_p": chunk.extra_model_outputs[Columns.ACTION_LOGP].data.tolist(),
        "dist_inputs": chunk.extra_model_outputs[Columns.ACTION_DIST_INPUTS].data.tolist(),
        "state": {key: array.tolist() for key, array in state.data.items()} if state else None,
    }


KINDS = {
    "simultaneous": spread(),
    "turns": tictactoe(),
    "several": solvable("several", num_envs=3),
    "numbers": solvable("numbers", num_envs=3),
    "memory": solvable("remembering", num_envs=3, recurrence={"width": 4, "sequence": 8}),
    "shared": solvable(
        "discrete", {"agents": 2}, {"a": ["player_0"], "b": ["player_1"]}, num_envs=3, shared_encoder=True
    ),
    "rllib": simultaneous(RLLIB_MEETING),
    "fast seeds": leduc(seeds="fast"),
    "early": simultaneous(MEETING, 3, {"arrives": [0, 1, 0], "leaves": [2, 4, 3], "truncated": [1]}),
}


@pytest.mark.parametrize("league", KINDS.values(), ids=KINDS)
def test_chunks_equal_the_outputs_of_the_module(league: LeagueConfig) -> None:
    """Distribution inputs and log-probabilities, recomputed from observations, states and raw actions."""
    runner = runner_of(league)
    chunks = [chunk for _ in range(4) for chunk in runner.sample(num_timesteps=25)]
    assert {chunk.module_id for chunk in chunks} == set(runner.interface.policy_ids)
    for chunk in chunks:
        module, extra = runner.module[chunk.module_id], chunk.extra_model_outputs
        batch: dict[str, Any] = {
            Columns.OBS: {name: torch.from_numpy(array[:-1].copy()) for name, array in chunk.observations.data.items()}
        }
        if module.is_stateful():
            states = extra[Columns.STATE_IN].data
            batch[Columns.STATE_IN] = {key: torch.from_numpy(array.copy()) for key, array in states.items()}
        answer = module.forward_exploration(batch)
        dist_inputs = answer[Columns.ACTION_DIST_INPUTS]
        raw = torch.from_numpy(chunk.actions.data.copy())
        log_p, _ = module.distribution.evaluate(dist_inputs, raw)
        np.testing.assert_allclose(extra[Columns.ACTION_DIST_INPUTS].data, dist_inputs.numpy(), atol=1e-5)
        np.testing.assert_allclose(extra[Columns.ACTION_LOGP].data, log_p.numpy(), atol=1e-4)
        space = runner.interface.of_policy(chunk.module_id).action
        for action in to_environment(chunk.actions.data, space):
            assert to_gymnasium(space).contains(action)
        if module.is_stateful() and chunk.t_started == 0:
            for key, initial in module.get_initial_state().items():
                np.testing.assert_array_equal(states[key][0], initial)
                after = answer[Columns.STATE_OUT][key][:-1].numpy()
                np.testing.assert_allclose(states[key][1:], after, atol=1e-5)


@pytest.mark.parametrize("league", KINDS.values(), ids=KINDS)
def test_runners_reset_at_the_same_step_play_identically(league: LeagueConfig) -> None:
    first, second = runner_of(league), runner_of(league)
    first.sample(num_timesteps=37)
    for runner in (first, second):
        runner.reset_episodes(5000)
    mine, theirs = ([columns(chunk) for chunk in runner.sample(num_timesteps=60)] for runner in (first, second))
    assert mine == theirs
    second.reset_episodes(5001)
    assert [columns(chunk) for chunk in second.sample(num_timesteps=60)] != mine


def test_fast_seeds_change_the_episodes_of_training() -> None:
    fast, stock = (
        [columns(chunk) for chunk in runner_of(leduc(seeds=seeds)).sample(num_timesteps=60)]
        for seeds in ("fast", "stock")
    )
    assert fast != stock


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.entry_point.rpartition(".")[2])
def test_a_reset_removes_the_history_of_the_environment(case: Case) -> None:
    """Resumed training depends on it, in each environment of PettingZoo and mpe2."""
    league = case.league()
    first, second = runner_of(league), runner_of(league)
    first.sample(num_timesteps=40)
    for runner in (first, second):
        runner.reset_episodes(5000)
    mine, theirs = ([columns(chunk) for chunk in runner.sample(num_timesteps=40)] for runner in (first, second))
    assert mine == theirs
    for runner in (first, second):
        runner.stop()


def test_agents_that_join_late_and_leave_early_have_their_own_steps_and_endings() -> None:
    runner = runner_of(KINDS["early"])
    chunks = runner.sample(num_episodes=9)
    complete = {chunk.agent_id: chunk for chunk in chunks if chunk.is_done}
    assert {agent: len(chunk) for agent, chunk in complete.items()} == {"agent_0": 2, "agent_1": 3, "agent_2": 3}
    assert complete["agent_1"].is_truncated
    assert not complete["agent_1"].is_terminated
    assert complete["agent_0"].is_terminated
    assert complete["agent_2"].rewards.data.tolist() == [100.0] * 3
    metrics = runner.get_metrics()
    assert metrics[EPISODE_LEN_MEAN].peek() == 4
    assert metrics[EPISODE_RETURN_MEAN].peek() == 2 + 30 + 300
    assert {policy: stat.peek() for policy, stat in metrics[EPISODE_MODULE_RETURN_MEAN].items()} == {
        "policy_0": 2.0,
        "policy_1": 30.0,
        "policy_2": 300.0,
    }
    assert metrics[EPISODE_AGENT_RETURN_MEAN]["agent_2"].peek() == 300
    assert metrics[EPISODE_AGENT_LEN_MEAN]["agent_2"].peek() == 3
    assert metrics[EPISODE_MODULE_LEN_MEAN]["policy_0"].peek() == 2


@pytest.mark.parametrize("plies", [0, 4])
def test_a_simultaneous_step_is_one_opening_ply(plies: int) -> None:
    runner = runner_of(spread(opening_plies=plies, num_envs=4))
    chunks = runner.sample(num_episodes=40)
    lengths = defaultdict(set)
    for chunk in chunks:
        if chunk.is_done and chunk.t_started == 0:
            lengths[chunk.agent_id].add(len(chunk))
    assert all(found == set(range(6 - plies, 7)) for found in lengths.values())


def test_all_policies_act_in_one_pass_per_step() -> None:
    league = KINDS["shared"]
    runner = runner_of(league)
    passes = []
    runner.module.encoder.register_forward_hook(lambda _, inputs, __: passes.append(len(inputs[0]["observation"])))
    runner.sample(num_timesteps=60)
    assert passes == [6] * 10


def test_greedy_play_takes_the_mode() -> None:
    for chunk in runner_of(KINDS["numbers"]).sample(num_timesteps=30, explore=False):
        means = chunk.extra_model_outputs[Columns.ACTION_DIST_INPUTS].data[:, :2]
        np.testing.assert_array_equal(chunk.actions.data, means)


def test_sampling_preserves_the_number_of_threads() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        runner_of(tictactoe()).sample(num_timesteps=10)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def crashing(seeds: list[int], **training: Any) -> LeagueConfig:
    return simultaneous(MEETING, 2, {"leaves": [4, 4], "crashes": seeds}, **training)


def seeds_of_episodes(*places: tuple[int, int]) -> list[int]:
    """The seeds of some (environment, episode) of the league above."""
    seeds = ResetSeeds.of_run(5, runner=0, runners=1, num_envs=3, steps=0)
    return [seeds(env, episode) for env, episode in places]


def test_a_crash_costs_its_own_episode_and_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    seeds = seeds_of_episodes((0, 0), (1, 2), (1, 3))
    runner = runner_of(crashing(seeds))
    with caplog.at_level(logging.WARNING):
        chunks = runner.sample(num_episodes=30)
    assert sum("the simulator is gone" in record.getMessage() for record in caplog.records) == 3
    metrics = runner.get_metrics()
    assert metrics[CRASHES].peek() == 3
    episodes = metrics[NUM_EPISODES].peek()
    assert metrics[EPISODE_LEN_MEAN].peek() == 4
    done = [chunk for chunk in chunks if chunk.is_done]
    assert len(done) == 2 * episodes
    assert all(len(chunk) == 4 for chunk in done)
    # Both agents played two steps in each crashed episode, which are in no chunk.
    under_way = sum(len(chunk) for chunk in chunks if not chunk.is_done)
    assert metrics[NUM_ENV_STEPS_SAMPLED].peek() == sum(map(len, done)) + under_way + 3 * 4
    lost = {int(seed) % 97 for seed in seeds}
    assert not lost & {int(chunk.observations.data["observation"][0][2]) for chunk in done}
    assert runner.get_metrics()[CRASHES].peek() == 0


def test_too_many_consecutive_crashes_are_raised() -> None:
    places = [(0, episode) for episode in range(3)]
    with pytest.raises(RuntimeError, match="the simulator is gone"):
        runner_of(crashing(seeds_of_episodes(*places), crashes=2)).sample(num_episodes=30)


def test_an_invalid_reward_names_the_league(monkeypatch: pytest.MonkeyPatch) -> None:
    step = Simultaneous.step

    def step_with_nan(self: Simultaneous, actions: dict[str, int]) -> tuple[dict, ...]:
        seen, rewards, *flags = step(self, actions)
        return seen, rewards | {"agent_1": float("nan")}, *flags

    runner = runner_of(simultaneous(MEETING))
    monkeypatch.setattr(Simultaneous, "step", step_with_nan)
    with pytest.raises(InvalidReward, match=r"^league together: agent agent_1 got a reward of nan"):
        runner.sample(num_timesteps=30)


def test_a_fault_at_setup_names_the_league_once() -> None:
    league = spread()
    config = algorithm_config(league, interface(league))
    config.env_config["league"]["training"]["opponents"] = [{"ref": "script:random", "share": 1.0}]
    config.env_config["interface"]["sides"] = {"team": ["agent_0", "agent_1", "agent_2"]}
    with pytest.raises(ConfigError, match=r"^league spread: training\.opponents: the league has one side only"):
        BatchedEnvRunner(config, worker_index=0)


def test_environments_are_closed_and_rebuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []
    monkeypatch.setattr(lockstep.Lockstep, "close", lambda self: closed.append(self))
    runner = runner_of(counting([3, 3], []))
    first = runner.env
    runner.sample(num_timesteps=10)
    runner.make_env()
    assert closed == [first]
    runner.assert_healthy()
    assert runner.sample(num_timesteps=10)
    runner.stop()
    runner.stop()
    assert len(closed) == 2


def test_an_episode_has_one_member_of_a_mixture_as_opponent(tmp_path: Path) -> None:
    storage = Storage.at(tmp_path)
    registry = Registry.open(storage)
    registry.leagues.register(registries.config(), registries.interface())
    for seed in range(2):
        build = registries.builder(graph=masked_mlp((3, 3, 2), actions=9, seed=seed))
        registry.publisher.publish("tictactoe", build, source=f"run/{seed}", parent=None)
    mixture = registry.publisher.publish_mixture("tictactoe", {1: 0.25, 2: 0.75})
    registry.close()
    runner = runner_of(tictactoe(opponents=[{"ref": mixture.ref, "share": 1.0}]), storage)
    runner.sample(num_episodes=200)
    played = runner.get_metrics()[OPPONENTS]
    games = {ref: values[GAMES].peek() for ref, values in played.items()}
    assert games.keys() == {"tictactoe@1", "tictactoe@2"}
    assert 0.1 < games["tictactoe@1"] / sum(games.values()) < 0.4
    runner.stop()


def test_a_version_plays_the_other_side_with_exploration(tmp_path: Path) -> None:
    """It is loaded once, even after a reset; its moves are in no chunk."""
    storage = Storage.at(tmp_path)
    registry = Registry.open(storage)
    registry.leagues.register(registries.config(), registries.interface())
    graph = masked_mlp((3, 3, 2), actions=9)
    row = registry.publisher.publish("tictactoe", registries.builder(graph=graph), source="run/1", parent=None)
    registry.close()
    runner = runner_of(tictactoe(opponents=[{"ref": row.ref, "share": 1.0}]), storage)
    opponents = runner._play._opponents  # type: ignore[union-attr]
    assert isinstance(opponents, Opponents)
    chunks = runner.sample(num_episodes=20)
    runner.reset_episodes(1000)
    chunks += runner.sample(num_episodes=20)
    assert runner._play._opponents is opponents  # type: ignore[union-attr]
    assert {chunk.agent_id for chunk in chunks} == {"player_1", "player_2"}
    metrics = runner.get_metrics()
    own = metrics[NUM_MODULE_STEPS_SAMPLED]["shared"].peek()
    assert 0.4 < own / metrics[NUM_ENV_STEPS_SAMPLED].peek() < 0.6
    # One agent of each episode learns.
    assert sum(chunk.is_done for chunk in chunks) == metrics[NUM_EPISODES].peek()
