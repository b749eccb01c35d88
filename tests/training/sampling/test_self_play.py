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
from league.random.seeds import generator
from league.results.records import Scoring
from tests.support.environments.scripted_environment import AgentRecord, EpisodeRecord, Scripted, interface
from tests.support.examples import examples
from tests.support.policies.self_play import FRAGMENT_LENGTHS, INITIAL, RANDOM, forward
from training.sampling.episode_chunks import as_episodes
from training.sampling.opponents import OpponentPolicy
from training.sampling.recorder import EpisodeRecorder
from training.sampling.reset_seeds import SEEDS, ResetSeeds
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
    episodes = defaultdict(list)
    for chunk in sorted(chunks, key=lambda chunk: chunk.t_started):
        agent, seed, _ = chunk.observations.data["observation"][0].astype(int)
        assert (chunk.agent_id, chunk.module_id) == (f"agent_{agent}", f"policy_{agent % 2}")
        episodes[seed, agent].append(chunk)
    return episodes


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
    probabilities = p[np.arange(len(chunk)), chunk.actions.data]
    np.testing.assert_allclose(np.exp(extra[Columns.ACTION_LOGP].data), probabilities, rtol=1e-5)
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
@examples(100)
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
    recorded = by_agent_of_episode(chunks)
    ids = [chunk.id_ for chunk in chunks]
    assert len(set(ids)) == len(ids)
    for (seed, agent), parts in recorded.items():
        played = env.played[seed]
        check_agent(parts, played.agents[agent], played, seed, agent)
    for seed, played in env.played.items():
        for agent, record in played.agents.items():
            rows = [group for group in record.groups if record.is_own(group)]
            closed = len(rows) - (record.ending is None)
            if not played.is_lost and closed > 0:
                assert sum(map(len, recorded[seed, agent])) == closed


@given(fragment_lengths=FRAGMENT_LENGTHS)
@settings(max_examples=30)
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
        by = {agent: set(record.groups) for agent, record in played.agents.items() if record.groups}
        assert all(len(groups) == 1 for groups in by.values())
        opponents = {
            agent for agent, groups in by.items() if isinstance(play._controllers[next(iter(groups))], OpponentPolicy)
        }
        assert not opponents & learning[seed]
        assert opponents in (set(), opponents & {0, 2}, opponents & {1, 3})
        opposed.append((bool(opponents & {0, 2}), bool(opponents & {1, 3})))
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
    rows = [group for episode in env.played.values() for record in episode.agents.values() for group in record.groups]
    waiting = sum(len(batch) for batch in play._turn.batches.values())
    assert play.metrics.steps == len(rows) - waiting
    expected = []
    for episode in finished:
        steps, returns = [0] * 3, [0.0] * 3
        for agent, record in episode.agents.items():
            if record.ending and record.groups and record.is_own(record.groups[0]):
                steps[agent], returns[agent] = len(record.groups), sum(record.rewards) + record.ending.reward
        if any(steps):
            expected.append((episode.steps, steps, returns))
    logged = [
        entry
        for done in play.metrics._finished
        for entry in zip(done.lengths.tolist(), done.steps.tolist(), done.returns.tolist(), strict=True)
    ]
    assert sorted(logged) == sorted(expected)


sizes = st.integers(1, 5)


def seeds_of_attempt(seed: int, runners: int, num_envs: int, episodes: int, steps: int = 0) -> list[int]:
    """The seeds of one attempt in which each environment starts `episodes` episodes."""
    return [
        ResetSeeds.of_run(seed, runner=runner, runners=runners, num_envs=num_envs, steps=steps)(env, episode)
        for runner in range(runners)
        for env in range(num_envs)
        for episode in range(episodes)
    ]


@given(st.integers(0, 2**40), sizes, sizes, st.integers(1, 20))
def test_no_two_resets_share_a_seed(seed: int, runners: int, num_envs: int, episodes: int) -> None:
    seeds = seeds_of_attempt(seed, runners, num_envs, episodes)
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= number < SEEDS for number in seeds)


@given(sizes, sizes, st.integers(0, 1000), st.lists(st.lists(sizes, min_size=1, max_size=8), min_size=2, max_size=5))
def test_a_restart_uses_no_seed_of_earlier_attempts(
    runners: int, num_envs: int, steps: int, attempts: list[list[int]]
) -> None:
    """An attempt is a list of samples: the minimum number of actions in each environment. Each environment of each
    runner may have used the maximum number of seeds: one at the start, and one after each step, in the sample that ends
    a step late.
    """
    used_seeds: set[int] = set()
    for samples in attempts:
        turns = sum(share + 1 for share in samples)
        new = seeds_of_attempt(3, runners, num_envs, turns + 1, steps)
        assert not used_seeds & set(new)
        used_seeds |= set(new)
        # All runners together count at least the share of each.
        steps += sum(share * num_envs * runners for share in samples)


def test_a_restart_at_the_same_step_has_the_same_seeds() -> None:
    assert seeds_of_attempt(1, 2, 3, 4, steps=77) == seeds_of_attempt(1, 2, 3, 4, steps=77)


def test_runs_with_other_seeds_have_other_seeds() -> None:
    first, second = (ResetSeeds.of_run(seed, runner=0, runners=1, num_envs=1, steps=0)(0, 0) for seed in (0, 1))
    assert abs(first - second) > 1000
