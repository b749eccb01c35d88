"""What a run uses where its configuration says `auto`: a pure function of the configuration and the nodes."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from league.config.league import LeagueConfig
from league.environments.building import interface
from policy_league.configs import bundled
from tests.support.leagues.training_leagues import counting, tictactoe
from training.algorithms.resources import (
    FEWEST_STOCK_ENVS,
    FEWEST_VECTOR_ENVS,
    MAX_THREADS,
    STEPS_PER_BATCH,
    Nodes,
    describe,
    resources,
)
from training.algorithms.rllib_config import algorithm_config

ALL_AUTO = dict.fromkeys(("runners", "num_envs", "learners", "threads", "gpus"), "auto")
TEACHER = {"ref": "script:random", "weight": 1.0}
CONVOLUTIONS = [{"filters": 8, "kernel": 3}]


def machine(cores: float, gpus: float = 0.0) -> Nodes:
    return [{"CPU": cores} | ({"GPU": gpus} if gpus else {})]


def vectorised(**training: Any) -> LeagueConfig:
    return tictactoe(**ALL_AUTO | training)


def stock(**training: Any) -> LeagueConfig:
    return counting([4, 6], [1], **ALL_AUTO | training)


def test_learners_divide_the_cores_that_runners_leave() -> None:
    several = [vectorised(learners=learners, gpus=1, runners=1) for learners in (1, 2, 4)]
    assert [resources(league, 2, machine(8, 4)).threads for league in several] == [4, 3, 1]
    assert "2 learners of 3 threads and 1 GPU" in describe(several[1], 2, machine(8, 4))


def test_one_learner_is_chosen_on_any_machine(subtests: pytest.Subtests) -> None:
    rows: list[tuple[dict[str, Any], Nodes]] = [
        ({"minibatch_size": 4096}, machine(64)),
        ({"minibatch_size": 4096, "hidden": [1024]}, machine(64, 8)),
        ({"algorithm": "dqn"}, machine(64)),
    ]
    for training, nodes in rows:
        with subtests.test(str(training)):
            assert resources(vectorised(**training), 2, nodes).learners == 1


def test_learners_on_gpus_have_cores_that_do_not_sample() -> None:
    rows = [vectorised(learners=learners, gpus=1, train_batch_size=2**17) for learners in (1, 3)]
    assert [resources(league, 2, machine(16, 4)).runners for league in rows] == [15, 13]


def test_batches_grow_with_the_machine(subtests: pytest.Subtests) -> None:
    rows: list[tuple[dict[str, Any], Nodes, int]] = [
        ({}, machine(2), 1),
        ({}, machine(4), 2),
        ({}, machine(16), 8),
        ({}, machine(64), 8),
        ({"minibatch_size": 1500}, machine(16), 2),
        ({"minibatch_size": 4096}, machine(64), 1),
        ({"convolutions": CONVOLUTIONS}, machine(2, 1), 16),
        ({"minibatch_size": 64, "convolutions": CONVOLUTIONS}, machine(16, 1), 64),
        ({"steps": 1_000_000, "minutes": None}, machine(16), 1),
        ({"steps": 3_000_000, "minutes": None}, machine(16), 4),
        ({"batch_scale": 3}, machine(2), 3),
        ({"algorithm": "dqn"}, machine(16), 1),
    ]
    for training, nodes, expected in rows:
        batch = {} if "algorithm" in training else {"train_batch_size": 4096, "minibatch_size": 512}
        league = vectorised(**{"steps": None, "minutes": 1.0, **batch, **training})
        with subtests.test(str(training), nodes=nodes):
            assert resources(league, 2, nodes).batch_scale == expected
            assert (f"batches of {expected} times the" in describe(league, 2, nodes)) == (expected > 1)


def test_batches_of_stock_environments_are_not_scaled() -> None:
    assert resources(stock(steps=None, minutes=1.0), 2, machine(64, 8)).batch_scale == 1


def test_a_larger_batch_has_more_environments() -> None:
    league = vectorised(train_batch_size=512, minibatch_size=64)
    used = [resources(league.with_training(batch_scale=scale), 2, machine(2)) for scale in (1, 2, 4)]
    assert [part.num_envs for part in used] == [16, 32, 64]
    configs = [algorithm_config(league.with_training(**part.settings), interface(league)) for part in used]
    assert [config.train_batch_size_per_learner for config in configs] == [512, 1024, 2048]
    assert [config.minibatch_size for config in configs] == [64, 128, 256]


def test_the_choice_fits_the_nodes_and_each_agent_gets_enough_steps(subtests: pytest.Subtests) -> None:
    rows: list[tuple[LeagueConfig, Nodes, tuple[float, ...]]] = [
        (vectorised(), machine(1), (0, 128, 1, 0)),
        (vectorised(), machine(2), (1, 128, 1, 0)),
        (vectorised(), machine(16), (2, 64, 4, 0)),
        (vectorised(lag=0), machine(16), (0, 128, 4, 0)),
        (vectorised(teacher=TEACHER), machine(2), (1, 128, 1, 0)),
        (vectorised(teacher=TEACHER), machine(16), (8, 16, 4, 0)),
        (vectorised(teacher=TEACHER, lag=0), machine(4), (4, 32, 4, 0)),
        (stock(), machine(2), (2, 32, 1, 0)),
        (stock(), machine(16), (14, 9, 2, 0)),
        (stock(train_batch_size=1024), machine(64), (16, 2, 4, 0)),
        (stock(), [{"CPU": 2.0}, {"CPU": 2.0}, {"memory": 1.0}], (4, 32, 1, 0)),
        (vectorised(hidden=[1024]), machine(16, 2), (15, 8, 1, 1)),
        (vectorised(convolutions=CONVOLUTIONS), machine(2, 0.5), (1, 128, 1, 0.5)),
        (vectorised(), machine(2, 1), (1, 128, 1, 0)),
        (vectorised(hidden=[1024], runner_gpus=0.1), machine(2, 1), (1, 128, 1, 0)),
        (vectorised(hidden=[1024]), [{"CPU": 2.0}, {"GPU": 1.0}], (1, 128, 1, 0)),
        (vectorised(algorithm="qmix"), machine(16, 1), (0, 32, 4, 0)),
        (stock(algorithm="dqn", update_every=100), machine(16), (3, 32, 4, 0)),
        (stock(algorithm="dqn", update_every=32), machine(16), (0, 32, 4, 0)),
        (vectorised(train_batch_size=512), machine(1), (0, 16, 1, 0)),
        (vectorised(train_batch_size=128, minibatch_size=64), machine(1), (0, FEWEST_VECTOR_ENVS, 1, 0)),
        (vectorised(train_batch_size=65536), machine(1), (0, 512, 1, 0)),
        (vectorised(runners=2), machine(1), (2, 64, 1, 0)),
        (vectorised(num_envs=7), machine(1), (0, 7, 1, 0)),
        (vectorised(algorithm="dqn"), machine(1), (0, 32, 1, 0)),
        (stock(train_batch_size=65536, minibatch_size=32), machine(1), (0, 32, 1, 0)),
        (stock(train_batch_size=512, minibatch_size=32), machine(1), (0, 16, 1, 0)),
        (stock(train_batch_size=32, minibatch_size=32), machine(1), (0, FEWEST_STOCK_ENVS, 1, 0)),
    ]
    for league, nodes, expected in rows:
        with subtests.test(training=league.training, nodes=nodes):
            used = resources(league, 2, nodes)
            assert (used.runners, used.num_envs, used.threads, used.gpus) == expected


any_league = st.builds(
    lambda make, algorithm, common, ppo: make(**common | ({"algorithm": algorithm} if algorithm != "ppo" else ppo)),
    st.sampled_from([vectorised, stock]),
    st.sampled_from(["ppo", "dqn", "qmix"]),
    st.fixed_dictionaries({"hidden": st.sampled_from([[16], [2048]])}),
    st.fixed_dictionaries(
        {
            "lag": st.integers(0, 2),
            "train_batch_size": st.integers(1, 2**17),
            "minibatch_size": st.just(1),
            "teacher": st.sampled_from([None, TEACHER]),
        }
    ),
)
any_nodes = st.lists(
    st.builds(lambda cores, gpus: {"CPU": cores, "GPU": gpus}, st.integers(0, 64), st.integers(0, 4)),
    min_size=1,
    max_size=3,
)


@given(any_league, st.integers(1, 20), any_nodes)
def test_the_choice_leaves_no_process_without_a_core(league: LeagueConfig, agents: int, nodes: Nodes) -> None:
    used, training = resources(league, agents, nodes), league.training
    cores = max(1, int(sum(node["CPU"] for node in nodes)))
    assert 0 <= used.runners <= cores
    assert 1 <= used.threads <= min(cores, MAX_THREADS)
    assert used.gpus <= max(node["GPU"] for node in nodes)
    samples = used.runners * used.num_envs * agents * STEPS_PER_BATCH
    if training.algorithm == "ppo" and used.runners > 1:
        assert samples <= training.train_batch_size * used.batch_scale


@given(any_league, st.integers(1, 20), any_nodes, any_nodes)
def test_what_is_recorded_is_repeated_on_other_nodes(
    league: LeagueConfig, agents: int, nodes: Nodes, others: Nodes
) -> None:
    used = resources(league, agents, nodes)
    recorded = league.with_training(**used.settings)
    assert resources(recorded, agents, others) == used
    assert "(" not in describe(recorded, agents, others), "nothing is chosen, so there is no reason"


@given(any_league, st.integers(1, 20), st.integers(1, 64), st.integers(0, 64))
def test_more_cores_never_sample_with_fewer_runners(
    league: LeagueConfig, agents: int, cores: int, further: int
) -> None:
    before, after = (resources(league, agents, machine(count)) for count in (cores, cores + further))
    assert before.runners <= after.runners


def test_the_choice_and_its_reason_are_one_line(subtests: pytest.Subtests) -> None:
    rows = [
        (
            vectorised(teacher=TEACHER),
            machine(2),
            "2 cores: 1 runner of 128 environments, a learner of 1 thread"
            " (the teacher acts in the runners: half of the cores sample).",
        ),
        (
            vectorised(hidden=[1024]),
            machine(16, 1),
            "16 cores, 1 GPU: 15 runners of 8 environments, a learner of 1 thread and 1 GPU"
            " (the learner is on the GPU: all other cores sample).",
        ),
        (
            vectorised(algorithm="dqn"),
            machine(2, 1),
            "2 cores, 1 GPU: 32 environments in the learner's process, a learner of 2 threads"
            " (dqn learns from small batches, faster on the CPU; rounds of dqn are too short for runners).",
        ),
        (
            vectorised(runners=14, num_envs=1, gpus=0, threads=2),
            machine(16, 1),
            "16 cores, 1 GPU: 14 runners of 1 environment, a learner of 2 threads.",
        ),
    ]
    for league, nodes, line in rows:
        with subtests.test(line):
            assert describe(league, 2, nodes) == line


def test_bundled_configurations_use_the_whole_machine_but_for_tiny_networks() -> None:
    """Networks whose batches take longer to send than to sample."""
    configs = {name: LeagueConfig.load(bundled.find(name)).training for name in bundled.names()}
    fixed = {name for name, training in configs.items() if training.runners != "auto"}
    assert fixed == {"kuhn_poker", "leduc_holdem", "liars_dice", "two_step_game"}
    assert {training.runners for name, training in configs.items() if name in fixed} == {0}
    assert all(training.threads == training.gpus == "auto" for training in configs.values())
