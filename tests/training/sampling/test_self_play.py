"""All that the protocol allows, played by two policies whose states count their steps."""

from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.errors import ConfigError
from league.policies.actions import to_environment
from league.seeds import generator
from league.training_config import OpponentConfig, PPOConfig
from tests.training.sampling.scripted import ACTIONS, Played, Scripted, Seen, interface
from training.modules.actor_critic import MASKED
from training.sampling.play_metrics import AgentEpisode
from training.sampling.recorder import Chunks
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.seats import Opposing
from training.sampling.self_play import Answer, Ask, SelfPlay

INITIAL = {"policy_0": {"steps": np.zeros(1, np.float32)}, "policy_1": {}}
RANDOM = OpponentConfig(ref="script:random", share=0.5)
CUTS = st.lists(st.integers(1, 9), min_size=1, max_size=12)
"""Steps between two cuts."""


def think(asks: Mapping[str, Ask]) -> dict[str, Answer]:
    """Logits that depend on the observation; the memory counts."""
    answers = {}
    for policy, ask in asks.items():
        seen = ask.observations["observation"]
        logits = np.sin(seen.sum(axis=1, keepdims=True) + np.arange(ACTIONS)).astype(np.float32)
        logits = np.where(ask.observations["action_mask"] != 0, logits, np.float32(MASKED))
        state = {key: value + 1 for key, value in ask.state.items()} if ask.state is not None else None
        answers[policy] = Answer(logits, state)
    return answers


def self_play(env: Scripted, sides: int = 2, **training: object) -> SelfPlay:
    config = PPOConfig.model_validate(training)
    described = interface(len(env.agents), sides)
    play = SelfPlay(env, described, config, Chunks(described, env.agents, env.copies), INITIAL)
    begin(play, env)
    return play


def begin(play: SelfPlay, env: Scripted, steps: int = 0) -> None:
    play.begin(ResetSeeds.of_run(3, runner=0, runners=1, copies=env.copies, steps=steps), generator(3, "play", steps))


def sampled(play: SelfPlay, cuts: Iterable[int]) -> list[SingleAgentEpisode]:
    chunks = []
    for steps in cuts:
        for _ in range(steps):
            play.step(think, explore=True)
        chunks += play.recorder.cut()
    return chunks


def put_together(chunks: Iterable[SingleAgentEpisode]) -> dict[tuple[int, int], list[SingleAgentEpisode]]:
    """(seed, agent) → its chunks, in order."""
    found = defaultdict(list)
    for chunk in chunks:
        agent, seed, _ = chunk.observations.data["observation"][0].astype(int)
        assert chunk.agent_id == f"agent_{agent}"
        assert chunk.module_id == f"policy_{agent % 2}"
        found[seed, agent].append(chunk)
    for own in found.values():
        own.sort(key=lambda chunk: chunk.t_started)
    return found


def check_agent(chunks: list[SingleAgentEpisode], seen: Seen, played: Played, seed: int, agent: int) -> int:
    """The chunks are the agent's rows from where its policy took over; returns their steps."""
    first = next(i for i, group in enumerate(seen.groups) if isinstance(group, str))
    assert all(isinstance(group, str) for group in seen.groups[first:])
    steps = 0
    for chunk in chunks:
        assert chunk.t_started == steps
        assert len(chunk) >= 1
        rows = first + steps + np.arange(len(chunk) + 1)
        expected = np.column_stack([np.full_like(rows, agent), np.full_like(rows, seed), rows])
        np.testing.assert_array_equal(chunk.observations.data["observation"], expected)
        later = [*seen.rewards, *([seen.ending.reward] if seen.ending else [])]
        assert chunk.rewards.data.tolist() == later[rows[1] : rows[-1] + 1]
        check_plays(chunk, steps)
        steps += len(chunk)
    *before, last = chunks
    assert not any(chunk.is_done for chunk in before)
    if played.is_lost:
        assert not last.is_done or seen.ending is not None
    elif seen.ending is not None and played.is_over:
        assert (last.is_terminated, last.is_truncated) == (seen.ending.terminated, seen.ending.truncated)
        assert steps == len(seen.groups) - first
        assert sum(sum(chunk.rewards.data) for chunk in chunks) == sum(seen.rewards[first + 1 :]) + seen.ending.reward
    return steps


def check_plays(chunk: SingleAgentEpisode, steps_before: int) -> None:
    """What was done on a row is beside its observation: logits, a legal action, its probability, and the state."""
    observations = {name: array[:-1] for name, array in chunk.observations.data.items()}
    extra = chunk.extra_model_outputs
    logits = think({"policy_1": Ask(observations, None)})["policy_1"].dist_inputs
    np.testing.assert_array_equal(extra[Columns.ACTION_DIST_INPUTS].data, logits)
    p = np.exp(logits - np.logaddexp.reduce(logits, axis=1, keepdims=True))
    chosen = p[np.arange(len(chunk)), chunk.actions.data]
    np.testing.assert_allclose(np.exp(extra[Columns.ACTION_LOGP].data), chosen, rtol=1e-5)
    if chunk.module_id == "policy_0":
        states = extra[Columns.STATE_IN].data["steps"]
        assert states.tolist() == [[step] for step in range(steps_before, steps_before + len(chunk))]
    else:
        assert Columns.STATE_IN not in extra


@given(
    agents=st.integers(1, 4),
    copies=st.integers(1, 3),
    crashing=st.sampled_from([0.0, 0.05, 0.3]),
    plies=st.sampled_from([0, 3]),
    opponents=st.sampled_from([[], [RANDOM]]),
    cuts=CUTS,
)
@settings(deadline=None, max_examples=150, suppress_health_check=[HealthCheck.too_slow])
def test_every_step_of_a_policy_is_there_once_and_nothing_else(
    agents: int, copies: int, crashing: float, plies: int, opponents: list[OpponentConfig], cuts: list[int]
) -> None:
    """However often it is cut, and whatever ends or crashes; opponents and openings leave no step."""
    if agents == 1:
        opponents = []
    env = Scripted(agents, copies, crashing)
    play = self_play(env, opening_plies=plies, opponents=opponents)
    chunks = sampled(play, cuts)
    found = put_together(chunks)
    ids = [chunk.id_ for chunk in chunks]
    assert len(set(ids)) == len(ids)
    for (seed, agent), own in found.items():
        played = env.played[seed]
        check_agent(own, played.agents[agent], played, seed, agent)
    for seed, played in env.played.items():
        for agent, seen in played.agents.items():
            rows = [group for group in seen.groups if isinstance(group, str)]
            closed = len(rows) - (seen.ending is None)
            if not played.is_lost and closed > 0:
                assert sum(map(len, found[seed, agent])) == closed


@given(cuts=CUTS)
@settings(deadline=None, max_examples=30)
def test_nothing_of_a_crashed_episode_comes_after_its_crash(cuts: list[int]) -> None:
    """What was cut before it is whole; what was open at the crash is in no chunk."""
    env = Scripted(3, 2, crashing=0.2)
    play = self_play(env)
    for steps in cuts:
        lost = {seed for seed, played in env.played.items() if played.is_lost}
        for _ in range(steps):
            play.step(think, explore=True)
        assert not {seed for seed, _ in put_together(play.recorder.cut())} & lost


def test_in_each_episode_an_opponent_plays_all_sides_but_one_or_none() -> None:
    env = Scripted(4, 3)
    play = self_play(env, opponents=[OpponentConfig(ref="script:random", share=0.75)])
    chunks = sampled(play, [400])
    learning = defaultdict(set)
    for chunk in chunks:
        agent, seed, _ = chunk.observations.data["observation"][0].astype(int)
        learning[seed].add(agent)
    opposed = []
    for seed, played in env.played.items():
        by = {agent: set(seen.groups) for agent, seen in played.agents.items() if seen.groups}
        assert all(len(groups) == 1 for groups in by.values())
        others = {agent for agent, groups in by.items() if isinstance(next(iter(groups)), Opposing)}
        assert not others & learning[seed]
        assert others in (set(), others & {0, 2}, others & {1, 3})
        opposed.append((bool(others & {0, 2}), bool(others & {1, 3})))
    share = np.mean([any(pair) for pair in opposed])
    assert 0.6 < share < 0.9
    assert abs(np.mean(opposed, axis=0) - share / 2).max() < 0.1


def test_an_opponent_needs_a_side() -> None:
    with pytest.raises(ConfigError, match=r"training\.opponents: the league has one side only"):
        self_play(Scripted(2, 1), sides=1, opponents=[RANDOM])


def test_a_version_as_opponent_needs_a_storage() -> None:
    with pytest.raises(ConfigError, match="somewhere@3 is a version, and there is no storage"):
        self_play(Scripted(2, 1), opponents=[OpponentConfig(ref="somewhere@3", share=1)])


def test_what_begins_anew_is_the_same_again() -> None:
    """Whatever was played before, by an environment of its own."""

    def after(steps_before: int) -> list[tuple[object, ...]]:
        env = Scripted(3, 2)
        play = self_play(env, opening_plies=2, opponents=[RANDOM])
        sampled(play, [steps_before])
        begin(play, env, steps=5000)
        return [
            (
                chunk.id_,
                chunk.agent_id,
                chunk.t_started,
                chunk.observations.data["observation"].tolist(),
                chunk.actions.data.tolist(),
                chunk.rewards.data.tolist(),
            )
            for chunk in sampled(play, [7, 20])
        ]

    assert after(11) == after(30)


def test_metrics_leave_out_opponents_and_lost_episodes() -> None:
    env = Scripted(3, 2, crashing=0.02)
    play = self_play(env, opponents=[RANDOM])
    sampled(play, [300])
    finished = [played for played in env.played.values() if played.is_over]
    assert play.metrics.episodes == len(finished)
    rows = [group for played in env.played.values() for seen in played.agents.values() for group in seen.groups]
    waiting = sum(len(batch.copies) for batch in play._turn.batches.values())
    assert play.metrics.steps == len(rows) - waiting
    expected = defaultdict(list)
    for played in finished:
        for agent, seen in played.agents.items():
            if seen.ending and seen.groups and isinstance(seen.groups[0], str):
                own = AgentEpisode(agent, len(seen.groups), sum(seen.rewards) + seen.ending.reward)
                expected[played.seed].append((played.steps, own))
    logged = [[(done.steps, agent) for agent in done.agents] for done in play.metrics._finished]
    assert sorted(map(repr, map(by_agent, logged))) == sorted(map(repr, map(by_agent, expected.values())))


def by_agent(episode: list[tuple[int, AgentEpisode]]) -> list[tuple[int, AgentEpisode]]:
    return sorted(episode, key=lambda entry: entry[1].agent)


def test_random_play_is_uniform_over_what_is_legal() -> None:
    env = Scripted(2, 3)
    play = self_play(env)
    for _ in range(60):
        play.step(None, explore=False)
    for chunk in play.recorder.cut():
        np.testing.assert_allclose(np.exp(chunk.extra_model_outputs[Columns.ACTION_LOGP].data), 0.5, rtol=1e-6)
        legal = to_environment(chunk.actions.data, interface(2).of_policy("policy_0").action)
        assert set(legal.tolist()) <= {1, 2, 3}
