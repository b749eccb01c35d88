"""The runner in each kind of environment, with each kind of policy, and with vectorised and stock environments."""

import logging
from collections import defaultdict
from collections.abc import Iterator
from contextlib import closing
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
from league.environments.copies import VectorCopies
from league.environments.implementation import stock_stepping
from league.environments.lockstep import Lockstep
from league.environments.stepping import BatchedEnvironment
from league.errors import ConfigError, InvalidReward
from league.policies.actions import to_environment
from league.registry.registry import Registry
from league.settings import Storage
from league.spaces.conversion import to_gymnasium
from tests.support.environments.cases import CASES
from tests.support.environments.simultaneous import Simultaneous
from tests.support.leagues import registries
from tests.support.leagues.training_leagues import counting, small, solvable, tictactoe
from tests.support.learners import equal, learner_of, update
from tests.support.policies.graphs import masked_mlp
from training.algorithms.rllib_config import algorithm_config
from training.sampling import env_runner
from training.sampling.env_runner import BatchedEnvRunner
from training.sampling.episode_chunks import EpisodeChunks
from training.sampling.opponents import Opponents
from training.sampling.play_metrics import CRASHES, ENTROPY, EPISODE_AGENT_LEN_MEAN, EPISODE_MODULE_LEN_MEAN
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import GAMES, OPPONENTS

MEETING = "tests.support.environments.simultaneous:meeting"
RLLIB_MEETING = "tests.support.environments.simultaneous:rllib_meeting"


SMALL_SPREAD: dict[str, Any] = {"kwargs": {"max_cycles": 6}, "num_envs": 2}


def simultaneous(entry_point: str, agents: int = 2, **options: Any) -> LeagueConfig:
    """Each agent has its own policy."""
    policies = {f"policy_{i}": [f"agent_{i}"] for i in range(agents)}
    return small(entry_point, policies=policies, name="together", **options)


def spread(**training: Any) -> LeagueConfig:
    return small("mpe2.simple_spread_v3", name="spread", **SMALL_SPREAD | training)


def leduc(**training: Any) -> LeagueConfig:
    return small("pettingzoo.classic.leduc_holdem_v4", **training)


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
    "early": simultaneous(MEETING, 3, kwargs={"arrives": [0, 1, 0], "leaves": [2, 4, 3], "truncated": [1]}),
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


ENVIRONMENTS = {case.entry_point.rpartition(".")[2]: case.league() for case in CASES}


@pytest.mark.parametrize("league", (KINDS | ENVIRONMENTS).values(), ids=KINDS | ENVIRONMENTS)
def test_runners_reset_at_the_same_step_play_identically(league: LeagueConfig) -> None:
    """Whatever was played before, in each environment of PettingZoo and mpe2: resumed training depends on it."""
    runners = [runner_of(league) for _ in range(2)]
    runners[0].sample(num_timesteps=37)
    plays = []
    for runner in runners:
        runner.reset_episodes(5000)
        plays.append([columns(chunk) for chunk in runner.sample(num_timesteps=40)])
    assert plays[0] == plays[1]
    for runner in runners:
        runner.stop()


def test_other_steps_and_seeds_give_other_play() -> None:
    plays = []
    for seed, steps in ((5, 5000), (5, 5001), (6, 5000)):
        runner = runner_of(tictactoe(seed=seed))
        runner.reset_episodes(steps)
        plays.append([columns(chunk)["actions"] for chunk in runner.sample(num_timesteps=60)])
    assert plays[0] not in plays[1:]


def test_fast_seeds_change_the_episodes_of_training() -> None:
    fast, stock = (
        [columns(chunk) for chunk in runner_of(leduc(seeds=seeds)).sample(num_timesteps=60)]
        for seeds in ("fast", "stock")
    )
    assert fast != stock


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
    returns = {policy: stat.peek() for policy, stat in metrics[EPISODE_MODULE_RETURN_MEAN].items()}
    assert returns == {"policy_0": 2.0, "policy_1": 30.0, "policy_2": 300.0}
    assert metrics[EPISODE_AGENT_RETURN_MEAN]["agent_2"].peek() == 300
    assert metrics[EPISODE_AGENT_LEN_MEAN]["agent_2"].peek() == 3
    assert metrics[EPISODE_MODULE_LEN_MEAN]["policy_0"].peek() == 2
    assert 0 < metrics["policy_0"][ENTROPY].peek() <= np.log(3) + 1e-6


@pytest.mark.parametrize("plies", [0, 4])
def test_a_simultaneous_step_is_one_opening_ply(plies: int) -> None:
    runner = runner_of(spread(opening_plies=plies, num_envs=4))
    chunks = runner.sample(num_episodes=40)
    lengths = defaultdict(set)
    for chunk in chunks:
        if chunk.is_done and chunk.t_started == 0:
            lengths[chunk.agent_id].add(len(chunk))
    assert [*lengths.values()] == [set(range(6 - plies, 7))] * 3
    metrics = runner.get_metrics()
    learned = sum(stat.peek() for stat in metrics[NUM_MODULE_STEPS_SAMPLED].values())
    assert (learned < metrics[NUM_ENV_STEPS_SAMPLED].peek()) == (plies > 0)


def test_all_policies_act_in_one_pass_per_step() -> None:
    league = KINDS["shared"]
    runner = runner_of(league)
    passes = []
    runner.module.encoder.register_forward_hook(lambda _, inputs, __: passes.append(len(inputs[0]["observation"])))
    runner.sample(num_timesteps=60)
    assert passes == [6] * 10


def test_sampling_preserves_the_number_of_threads() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        runner_of(tictactoe()).sample(num_timesteps=10)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def crashing(seeds: list[int], **training: Any) -> LeagueConfig:
    return simultaneous(MEETING, kwargs={"leaves": [4, 4], "crashes": seeds}, **training)


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
        observations, rewards, *flags = step(self, actions)
        return observations, rewards | {"agent_1": float("nan")}, *flags

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


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """With two versions."""
    with closing(Registry.open(Storage.at(tmp_path))) as registry:
        registry.leagues.register(registries.config(), registries.interface())
        for seed in range(2):
            build = registries.builder(graph=masked_mlp((3, 3, 2), actions=9, seed=seed))
            registry.publisher.publish("tictactoe", build, source=f"run/{seed}", parent=None)
        yield registry


def test_an_episode_has_one_member_of_a_mixture_as_opponent(registry: Registry) -> None:
    mixture = registry.publisher.publish_mixture("tictactoe", {1: 0.25, 2: 0.75})
    runner = runner_of(tictactoe(opponents=[{"ref": mixture.ref, "share": 1.0}]), registry.storage)
    runner.sample(num_episodes=200)
    games = {ref: values[GAMES].peek() for ref, values in runner.get_metrics()[OPPONENTS].items()}
    assert games.keys() == {"tictactoe@1", "tictactoe@2"}
    assert 0.1 < games["tictactoe@1"] / sum(games.values()) < 0.4
    runner.stop()


def test_a_version_plays_the_other_side_with_exploration(registry: Registry) -> None:
    """It is loaded once, even after a reset; its moves are in no chunk."""
    runner = runner_of(tictactoe(opponents=[{"ref": "tictactoe@1", "share": 1.0}]), registry.storage)
    opponents = runner._play._opponents  # type: ignore[union-attr]
    assert isinstance(opponents, Opponents)
    chunks = runner.sample(num_episodes=20)
    runner.reset_episodes(1000)
    chunks += runner.sample(num_episodes=20)
    assert runner._play._opponents is opponents  # type: ignore[union-attr]
    assert {chunk.agent_id for chunk in chunks} == {"player_1", "player_2"}
    metrics = runner.get_metrics()
    recorded = metrics[NUM_MODULE_STEPS_SAMPLED]["shared"].peek()
    assert 0.4 < recorded / metrics[NUM_ENV_STEPS_SAMPLED].peek() < 0.6
    # One agent of each episode learns.
    assert sum(chunk.is_done for chunk in chunks) == metrics[NUM_EPISODES].peek()


VECTORISED: dict[str, tuple[str, dict[str, Any]]] = {
    "opponents and openings": (
        "pettingzoo.classic.tictactoe_v3",
        {"opponents": [{"ref": "script:random", "share": 0.5}], "opening_plies": 2},
    ),
    "recurrent": ("pettingzoo.classic.connect_four_v3", {"recurrence": {"width": 4, "sequence": 3}}),
    "simultaneous": ("mpe2.simple_spread_v3", {}),
    "wrapped": ("mpe2.simple_tag_v3", {}),
}

WRAPPERS = ["pad_observations_v0", "agent_indicator_v0", {"frame_stack_v1": {"stack_size": 2}}, "clip_reward_v0"]


def in_lockstep(*args: Any, fast_seeds: bool, **options: Any) -> BatchedEnvironment:
    """`stepping`, without vectorised environments."""
    assert not fast_seeds
    return stock_stepping(*args, **options)


def trained(league: LeagueConfig) -> tuple[list[list[EpisodeChunks]], dict[str, Any]]:
    """Three samples with an update after each, and the final weights."""
    config = algorithm_config(league, interface(league))
    torch.manual_seed(0)
    runner = BatchedEnvRunner(config, worker_index=0)
    learner = learner_of(league)
    samples = []
    for _ in range(3):
        runner.module.set_state(learner.module.get_state())
        samples.append(runner.sample_chunks(num_timesteps=120))
        update(learner, samples[-1], num_epochs=1, minibatch_size=32)
    assert isinstance(runner.env, Lockstep)
    assert isinstance(runner.env.copies, VectorCopies) == (env_runner.stepping is not in_lockstep)
    runner.stop()
    return samples, learner.module.get_state()


@pytest.mark.parametrize("name", VECTORISED)
def test_samples_and_weights_do_not_depend_on_the_implementation(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    entry_point, training = VECTORISED[name]
    settings = {"runners": 0, "num_envs": 5, "hidden": [8], "train_batch_size": 120, "minibatch_size": 32}
    environment = {"entry_point": entry_point, "wrappers": WRAPPERS if name == "wrapped" else []}
    league = LeagueConfig.from_mapping({"league": "same", "environment": environment, "training": settings | training})
    vectorised = trained(league)
    monkeypatch.setattr(env_runner, "stepping", in_lockstep)
    stock = trained(league)
    for batches, stock_batches in zip(vectorised[0], stock[0], strict=True):
        assert [chunks.policy for chunks in batches] == [chunks.policy for chunks in stock_batches]
        for chunks, stock_chunks in zip(batches, stock_batches, strict=True):
            for column in EpisodeChunks.__slots__:
                assert equal(getattr(chunks, column), getattr(stock_chunks, column)), column
    assert equal(vectorised[1], stock[1])
