"""Episodes with everything the protocol allows, played by two policies whose states count their steps."""

from collections import defaultdict
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ray.rllib.core.columns import Columns
from ray.rllib.env.single_agent_episode import SingleAgentEpisode

from league.config.opponents import OpponentConfig
from league.config.ppo import PPOConfig
from league.errors import ConfigError
from league.policies.actions import to_environment
from league.random.seeds import generator
from league.results.records import Scoring
from tests.support.environments.scripted_environment import AgentRecord, EpisodeRecord, Scripted, interface
from tests.support.examples import examples
from tests.support.policies.self_play import FRAGMENT_LENGTHS, INITIAL, RANDOM, forward
from training.sampling.episode_chunks import as_episodes
from training.sampling.opponents import OpponentPolicy
from training.sampling.recorder import EpisodeRecorder
from training.sampling.reset_seeds import ResetSeeds
from training.sampling.self_play import ForwardInput, SelfPlay


def self_play(
    env: Scripted, sides: int = 2, opening_plies: int = 0, scoring: Scoring = "game", **training: object
) -> SelfPlay:
    config = PPOConfig.model_validate(training)
    interface_of_league = interface(len(env.agents), sides)
    recorder = EpisodeRecorder(interface_of_league, env.agents, env.num_envs)
    play = SelfPlay(env, interface_of_league, config, recorder, INITIAL, None, scoring, opening_plies=opening_plies)
    begin(play, env)
    return play


def begin(play: SelfPlay, env: Scripted, steps: int = 0) -> None:
    play.begin(
        ResetSeeds.of_run(3, runner=0, runners=1, num_envs=env.num_envs, steps=steps), generator(3, "play", steps)
    )


def sample(play: SelfPlay, fragment_lengths: Iterable[int]) -> list[SingleAgentEpisode]:
    chunks = []
    for steps in fragment_lengths:
        for _ in range(steps):
            play.step(forward, explore=True)
        chunks += cut(play)
    return chunks


def cut(play: SelfPlay) -> list[SingleAgentEpisode]:
    names = tuple(f"agent_{i}" for i in range(9))
    return [episode for chunks in play.recorder.cut() for episode in as_episodes(chunks, names)]


def by_agent_of_episode(chunks: Iterable[SingleAgentEpisode]) -> dict[tuple[int, int], list[SingleAgentEpisode]]:
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


def check_agent(
    chunks: list[SingleAgentEpisode], record: AgentRecord, episode: EpisodeRecord, seed: int, agent: int
) -> int:
    """The chunks are the agent's rows from the first one of its policy; returns their number of steps."""
    first = next(i for i, group in enumerate(record.groups) if record.is_own(group))
    assert all(record.is_own(group) for group in record.groups[first:])
    steps = 0
    for chunk in chunks:
        assert chunk.t_started == steps
        assert len(chunk) >= 1
        rows = first + steps + np.arange(len(chunk) + 1)
        expected = np.column_stack([np.full_like(rows, agent), np.full_like(rows, seed), rows])
        np.testing.assert_array_equal(chunk.observations.data["observation"], expected)
        later = [*record.rewards, *([record.ending.reward] if record.ending else [])]
        assert chunk.rewards.data.tolist() == later[rows[1] : rows[-1] + 1]
        check_outputs(chunk, steps)
        steps += len(chunk)
    *before, last = chunks
    assert not any(chunk.is_done for chunk in before)
    if episode.is_lost:
        assert not last.is_done or record.ending is not None
    elif record.ending is not None and episode.is_over:
        assert (last.is_terminated, last.is_truncated) == (record.ending.terminated, record.ending.truncated)
        assert steps == len(record.groups) - first
        assert (
            sum(sum(chunk.rewards.data) for chunk in chunks) == sum(record.rewards[first + 1 :]) + record.ending.reward
        )
    return steps


def check_outputs(chunk: SingleAgentEpisode, steps_before: int) -> None:
    """Each row has its outputs: logits, a legal action, its log-probability, and the state."""
    observations = {name: array[:-1] for name, array in chunk.observations.data.items()}
    extra = chunk.extra_model_outputs
    logits = forward({"policy_1": ForwardInput(observations, None)})["policy_1"].dist_inputs
    np.testing.assert_allclose(extra[Columns.ACTION_DIST_INPUTS].data, logits, rtol=1e-6, atol=1e-6)
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
    num_envs=st.integers(1, 3),
    crashing=st.sampled_from([0.0, 0.05, 0.3]),
    plies=st.sampled_from([0, 3]),
    opponents=st.sampled_from([[], [RANDOM]]),
    fragment_lengths=FRAGMENT_LENGTHS,
)
@examples(150)
def test_each_step_of_a_policy_is_recorded_once(
    agents: int,
    num_envs: int,
    crashing: float,
    plies: int,
    opponents: list[OpponentConfig],
    fragment_lengths: list[int],
) -> None:
    """For all fragment lengths, endings and crashes; steps of opponents and openings are not recorded."""
    if agents == 1:
        opponents = []
    env = Scripted(agents, num_envs, crashing)
    play = self_play(env, opening_plies=plies, opponents=opponents)
    chunks = sample(play, fragment_lengths)
    found = by_agent_of_episode(chunks)
    ids = [chunk.id_ for chunk in chunks]
    assert len(set(ids)) == len(ids)
    for (seed, agent), own in found.items():
        played = env.played[seed]
        check_agent(own, played.agents[agent], played, seed, agent)
    for seed, played in env.played.items():
        for agent, seen in played.agents.items():
            rows = [group for group in seen.groups if seen.is_own(group)]
            closed = len(rows) - (seen.ending is None)
            if not played.is_lost and closed > 0:
                assert sum(map(len, found[seed, agent])) == closed


@given(fragment_lengths=FRAGMENT_LENGTHS)
@settings(deadline=None, max_examples=30)
def test_a_crashed_episode_is_not_continued(fragment_lengths: list[int]) -> None:
    """Chunks from before the crash are complete; open steps are dropped."""
    env = Scripted(3, 2, crashing=0.2)
    play = self_play(env)
    for steps in fragment_lengths:
        lost = {seed for seed, episode in env.played.items() if episode.is_lost}
        for _ in range(steps):
            play.step(forward, explore=True)
        assert not {seed for seed, _ in by_agent_of_episode(cut(play))} & lost


def test_an_opponent_plays_all_sides_but_one() -> None:
    env = Scripted(4, 3)
    play = self_play(env, opponents=[OpponentConfig(ref="script:random", share=0.75)])
    chunks = sample(play, [400])
    learning = defaultdict(set)
    for chunk in chunks:
        agent, seed, _ = chunk.observations.data["observation"][0].astype(int)
        learning[seed].add(agent)
    opposed = []
    for seed, played in env.played.items():
        by = {agent: set(seen.groups) for agent, seen in played.agents.items() if seen.groups}
        assert all(len(groups) == 1 for groups in by.values())
        others = {
            agent for agent, groups in by.items() if isinstance(play._controllers[next(iter(groups))], OpponentPolicy)
        }
        assert not others & learning[seed]
        assert others in (set(), others & {0, 2}, others & {1, 3})
        opposed.append((bool(others & {0, 2}), bool(others & {1, 3})))
    share = np.mean([any(pair) for pair in opposed])
    assert 0.6 < share < 0.9
    assert abs(np.mean(opposed, axis=0) - share / 2).max() < 0.1


def test_an_opponent_needs_another_side() -> None:
    with pytest.raises(ConfigError, match=r"training\.opponents: the league has one side only"):
        self_play(Scripted(2, 1), sides=1, opponents=[RANDOM])


def test_opponents_forget_an_episode_when_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    env = Scripted(3, 2)
    play = self_play(env, opponents=[RANDOM])
    forgotten: list[int] = []
    monkeypatch.setattr(play._opponents, "forget", lambda envs: forgotten.extend(envs.tolist()))
    sample(play, [60])
    assert len(forgotten) == sum(episode.is_over for episode in env.played.values()) > 2
    assert set(forgotten) == {0, 1}


def test_a_version_as_opponent_needs_a_storage() -> None:
    with pytest.raises(ConfigError, match="somewhere@3 is a version, but no storage"):
        self_play(Scripted(2, 1), opponents=[OpponentConfig(ref="somewhere@3", share=1)])


def test_a_restart_is_reproducible() -> None:
    """For any earlier episodes, in a new environment."""

    def chunks_after(steps_before: int) -> list[tuple[object, ...]]:
        env = Scripted(3, 2)
        play = self_play(env, opening_plies=2, opponents=[RANDOM])
        sample(play, [steps_before])
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
            for chunk in sample(play, [7, 20])
        ]

    assert chunks_after(11) == chunks_after(30)


def test_games_do_not_wait_for_a_partner_beyond_a_restart() -> None:
    def results_after(steps_before: int) -> tuple[list[float], ...]:
        env = Scripted(2, 2)
        play = self_play(env, scoring="side", opponents=[RANDOM])
        sample(play, [steps_before])
        play._scores.take(1)
        begin(play, env, steps=5000)
        sample(play, [50])
        results = play._scores.take(1)
        return results.episodes.tolist(), results.games.tolist(), results.scores.tolist()

    fresh = results_after(0)
    assert fresh[0] > [4]
    assert all(results_after(steps) == fresh for steps in (11, 30, 31))


def test_metrics_exclude_opponents_and_crashed_episodes() -> None:
    env = Scripted(3, 2, crashing=0.02)
    play = self_play(env, opponents=[RANDOM])
    sample(play, [300])
    finished = [episode for episode in env.played.values() if episode.is_over]
    assert play.metrics.episodes == len(finished)
    rows = [group for episode in env.played.values() for seen in episode.agents.values() for group in seen.groups]
    waiting = sum(len(batch) for batch in play._turn.batches.values())
    assert play.metrics.steps == len(rows) - waiting
    expected = []
    for episode in finished:
        steps, returns = [0] * 3, [0.0] * 3
        for agent, seen in episode.agents.items():
            if seen.ending and seen.groups and seen.is_own(seen.groups[0]):
                steps[agent], returns[agent] = len(seen.groups), sum(seen.rewards) + seen.ending.reward
        if any(steps):
            expected.append((episode.steps, steps, returns))
    logged = [
        entry
        for done in play.metrics._finished
        for entry in zip(done.lengths.tolist(), done.steps.tolist(), done.returns.tolist(), strict=True)
    ]
    assert sorted(logged) == sorted(expected)


def test_random_play_is_uniform_over_legal_actions() -> None:
    env = Scripted(2, 3)
    play = self_play(env)
    for _ in range(60):
        play.step(None, explore=False)
    for chunk in cut(play):
        np.testing.assert_allclose(np.exp(chunk.extra_model_outputs[Columns.ACTION_LOGP].data), 0.5, rtol=1e-6)
        legal = to_environment(chunk.actions.data, interface(2).of_policy("policy_0").action)
        assert set(legal.tolist()) <= {1, 2, 3}
