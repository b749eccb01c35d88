"""The game loop: what is recorded of a game, whichever others are played at once, in each kind of environment."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest, kstest

from evaluation.matches.game_loop import play_matches
from evaluation.matches.game_state import ActionNumbers, action_keys
from evaluation.matches.match_recorder import ActionLog
from evaluation.matches.openings import OpeningMoves
from evaluation.matches.policy_calls import PolicyFault, action_fault
from evaluation.matches.seating import Roster, acting_versions, contestant_returns, returns_of_games
from evaluation.matches.tournament import evaluate, play_schedule
from evaluation.playback.replay import live_game, recorded_game, replay
from evaluation.playback.single_game import play_game
from evaluation.schedules.builders import game_plans, round_robin
from league.config.league import LeagueConfig
from league.environments.building import interface
from league.environments.implementation import stepping, stock_stepping
from league.environments.stepping import Batch
from league.errors import EnvironmentMismatch, GameHung, InvalidInput
from league.policies.draws import probabilities
from league.policies.loading import contestant
from league.policies.onnx import OnnxPolicy
from league.policies.policy import Actions
from league.policies.scripted import script
from league.random.seeds import derive, generator
from league.registry.aliases import ANY
from league.registry.registry import Registry
from league.registry.storage.manifest import Member, Mixture
from league.results.ledger import Ledger
from league.results.records import Game, Match, Schedule, Scoring, dump_games, load_games
from league.results.scoring import admit
from league.spaces import Box, Discrete, Leaf, MultiBinary, MultiDiscrete
from tests.support.environments.kinds import KINDS, Kind
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.leagues import tictactoe
from tests.support.leagues.tournaments import STRENGTHS
from tests.support.policies.bots import MODULE
from tests.support.policies.graphs import masked_mlp


def schedule(blocks: int = 4, plies: int = 2, contestants: Sequence[str] = CONTESTANTS) -> Schedule:
    league = tictactoe.config(play={"opening_plies": plies})
    return round_robin(league, INTERFACE, contestants, blocks)


def play(schedule: Schedule, num_envs: int = 8, positions: Sequence[int] | None = None) -> list[Match]:
    environment = stock_stepping(CONFIG.environment, num_envs)
    return play_matches(
        schedule, range(schedule.length) if positions is None else positions, environment, INTERFACE, build_roster()
    )


@pytest.mark.parametrize("num_envs", [7, 32, 100])
def test_games_do_not_depend_on_other_games(num_envs: int) -> None:
    alone = play(schedule(), 1)
    assert play(schedule(), num_envs) == alone
    assert play(schedule(), num_envs, positions=[5, 0, 3]) == [alone[position] for position in (5, 0, 3)]


@pytest.mark.parametrize("name", ["Alternating", "sampled", "Failing", "all_at_once"])
def test_games_of_bots_do_not_depend_on_the_number_of_environments(name: str) -> None:
    contestants = ["script:random", f"script:{MODULE}:{name}"]
    of_bots, roster = (
        schedule(10, contestants=contestants),
        {ref: contestant(ref, None, INTERFACE) for ref in contestants},
    )
    alone, together = (
        play_matches(of_bots, range(10), stock_stepping(CONFIG.environment, num_envs), INTERFACE, roster)
        for num_envs in (1, 16)
    )
    assert alone == together


def test_a_block_shares_its_opening_and_exchanges_the_sides() -> None:
    for match in play(schedule()):
        first, second = match.games
        assert first.opening == second.opening
        assert len(first.opening) == 2
        assert (first.sides, second.sides) == ((0, 1), (1, 0))
        assert first.seed == second.seed == match.seed
    openings = {match.games[0].opening for match in play(schedule(blocks=40, contestants=CONTESTANTS[:2]))}
    assert len(openings) > 20, "they differ between blocks"


def test_openings_that_end_the_game_are_redrawn() -> None:
    """Six random moves sometimes end a game of tic-tac-toe; each recorded game continues after its opening."""
    matches = play(schedule(blocks=40, plies=6, contestants=CONTESTANTS[:2]))
    assert len(matches) == 40
    for match in matches:
        for game in match.games:
            assert len(game.opening) == 6
            assert game.actions
            assert sum(game.scores) == 1


def test_games_that_cannot_be_played_are_reported() -> None:
    with pytest.raises(EnvironmentMismatch, match="opening_plies"):
        play(schedule(plies=9), positions=[0])
    of_scripts = schedule(contestants=["script:random", "script:one_ply"])
    environment = stock_stepping(CONFIG.environment, 2)
    with pytest.raises(GameHung, match="script:random"):
        play_matches(of_scripts, [0], environment, INTERFACE, build_roster(), max_moves=4)


def test_without_openings_greedy_policies_repeat_their_games() -> None:
    matches = play(schedule(blocks=5, plies=0, contestants=CONTESTANTS[:2]))
    assert len({game.actions for match in matches for game in match.games}) == 2
    assert all(game.opening == () for match in matches for game in match.games)


def test_only_a_true_record_replays() -> None:
    environment = stock_stepping(CONFIG.environment, 1)
    for match in play(schedule()):
        for index, game in enumerate(match.games):
            steps = list(replay(environment, CONFIG, INTERFACE, match, index))
            assert [move.action for m in steps for move in m.moves] == [*game.opening, *game.actions]
    game = match.games[0]
    for forged in (
        {"games": (replace(game, returns=(0.5, 0.5)), match.games[1])},
        {"games": (replace(game, actions=game.actions[:-1]), match.games[1])},
        {"games": (replace(game, actions=(*game.actions, 0)), match.games[1])},
        {"games": (replace(game, actions=(game.opening[0], *game.actions[1:])), match.games[1])},
        {"environment_digest": "another"},
    ):
        with pytest.raises(EnvironmentMismatch):
            list(replay(environment, CONFIG, INTERFACE, replace(match, **forged), 0))


def test_openings_and_scripts_draw_from_the_generators_of_their_game() -> None:
    """These draws are part of recorded games and must never change."""
    for match in play(schedule(contestants=["script:random", "tictactoe@1"])):
        for index, game in enumerate(match.games):
            squares = list(range(9))
            openings = [generator(match.seed, "opening", 0, agent) for agent in (0, 1)]
            assert game.opening == tuple(squares.pop(int(len(squares) * draw.random())) for draw in openings)
            agent = game.sides.index(0)
            script = generator(match.seed, "policy", index, agent)
            for ply, action in enumerate(game.actions):
                if ply % 2 == agent:
                    assert action == squares[int(len(squares) * script.random())]
                squares.remove(action)


CONNECT_FOUR = LeagueConfig.load(Path(__file__).parents[3] / "policy_league/configs" / "connect_four.yaml")


FOUR = interface(CONNECT_FOUR)


MLP = CONNECT_FOUR.training.model_copy(update={"convolutions": (), "hidden": (256, 256)})


def play_networks(graphs: Sequence[OnnxPolicy], num_envs: int, blocks: int, stock: bool = False) -> list[Match]:
    """Games of connect four between two networks and a script."""
    spaces = FOUR.of_policy("shared")
    policies = dict(zip(("connect_four@1", "connect_four@2"), graphs, strict=True))
    policies["script:one_ply"] = script("one_ply", spaces.observation, spaces.action)
    roster = {ref: dict.fromkeys(FOUR.agents, ("shared", policy)) for ref, policy in policies.items()}
    matches = round_robin(CONNECT_FOUR, FOUR, list(policies), blocks)
    environment = (stock_stepping if stock else stepping)(CONNECT_FOUR.environment, num_envs)
    return play_matches(matches, range(matches.length), environment, FOUR, roster)


def test_games_of_large_networks_are_equal_in_any_number_of_environments() -> None:
    graphs = [OnnxPolicy(masked_mlp(hidden=(256, 256), seed=seed)) for seed in range(2)]
    expected = play_networks(graphs, 32, blocks=3, stock=True)
    assert len(expected) == 9
    for num_envs in (1, 5, 512):
        assert play_networks(graphs, num_envs, blocks=3) == expected


@pytest.mark.slow
@pytest.mark.parametrize("training", [MLP, CONNECT_FOUR.training], ids=["MLP", "convolutional"])
def test_exported_networks_compute_each_row_alone(tmp_path: Path, training: object) -> None:
    """Their outputs for a row are equal in every batch, to the last bit, and so are the games."""
    import torch

    from training.algorithms.rllib_config import module_spec
    from training.export.onnx_export import export_policy

    graphs = []
    for seed in range(2):
        torch.manual_seed(seed)
        module = module_spec(training, FOUR).build()["shared"].eval()
        export_policy(module, FOUR.of_policy("shared"), tmp_path / f"{seed}.onnx")
        graphs.append(OnnxPolicy(tmp_path / f"{seed}.onnx"))
    rng, rows = np.random.default_rng(0), 512
    observations = {
        "observation": (rng.random((rows, 6, 7, 2)) < 0.3).astype(np.int8),
        "action_mask": np.ones((rows, 7), np.int8),
    }
    together = graphs[0].distribution(observations).dist_inputs
    for size in (1, 2, 3, 8, 31, 32, 33, 512):
        parts = [
            graphs[0].distribution({name: array[i : i + size] for name, array in observations.items()}).dist_inputs
            for i in range(0, rows, size)
        ]
        np.testing.assert_array_equal(np.concatenate(parts), together)
    expected = play_networks(graphs, 1, blocks=100)
    assert play_networks(graphs, 32, blocks=100) == play_networks(graphs, 512, blocks=100) == expected


@pytest.mark.parametrize(("kind", "shape"), [(KINDS["team"], ()), (KINDS["continuous team"], (5,))])
def test_actions_use_the_numbers_of_the_generators_of_their_games(kind: Kind, shape: tuple[int, ...]) -> None:
    """Each agent continues its own numbers, and restarted openings have others."""
    seeds = np.array([3, 2**62, 2**31])
    openings = OpeningMoves(kind.interface, agents=3, seeds=seeds, plies=4)
    rngs = {(game, agent): generator(int(seeds[game]), "opening", 0, agent) for game in range(3) for agent in range(3)}
    rng = np.random.default_rng(0)
    for turn in range(4):
        if turn == 2:
            openings.restart(np.array([1]), np.array([7]))
            rngs |= {(1, agent): generator(2**62, "opening", 7, agent) for agent in range(3)}
        games, agents = np.array([0, 1, 1, 2]), rng.integers(3, size=4)
        agents[2] = (agents[1] + 1) % 3
        observation = np.zeros((4, 18), np.float32)
        actions = openings.act("shared", Batch(np.arange(4), agents, {"observation": observation}, np.zeros(4)), games)
        expected = [
            rngs[game, agent].random(shape) for game, agent in zip(games.tolist(), agents.tolist(), strict=True)
        ]
        scaled = np.array(expected) if shape else np.floor(np.array(expected) * 5)
        np.testing.assert_array_equal(actions, scaled.astype(actions.dtype))
    assert OpeningMoves(kind.interface, agents=3, seeds=np.array([1]), plies=0), "needs no numbers"


numbers = st.floats(-1e6, 1e6)


def test_returns_are_means_over_agents_and_then_sides() -> None:
    for side_of, sides, expected in (
        ([0, 1, 2], (0, 1, 1), (1.0, 6.0)),
        ([0, 1, 2], (1, 0, 1), (2.0, 5.5)),
        ([0, 0, 1], (1, 0), (10.0, 1.5)),
        ([0, 0, 0], (1,), (None, 13 / 3)),
        # Sides have the same weight, whatever their number of agents.
        ([0, 1, 1, 2], (0, 1, 1), (1.0, 6.5)),
    ):
        assert contestant_returns([1.0, 2.0, 10.0, 7.0][: len(side_of)], side_of, sides) == expected


@given(numbers, st.integers(1, 7), st.integers(2, 7))
def test_equal_returns_are_exactly_equal(value: float, agents: int, sides: int) -> None:
    """Equal returns are a draw, so that rounding must not make a mean of many differ from a mean of one."""
    side_of = [side for side in range(sides) for _ in range(agents)]
    assert contestant_returns([value] * len(side_of), side_of, (0, *[1] * (sides - 1))) == (value, value)


@given(st.sampled_from([[0, 1], [1, 0], [0, 0], [0, 1, 2], [1, 0, 1]]), st.data())
def test_many_games_have_the_returns_of_each(side_of: list[int], data: st.DataObject) -> None:
    sides = max(side_of) + 1
    seatings = [[int(side == seat) for side in range(sides)] for seat in range(sides)]
    returns = st.lists(numbers, min_size=len(side_of), max_size=len(side_of))
    games = data.draw(st.lists(st.tuples(st.sampled_from(seatings), returns), max_size=5))
    values = np.array([of_game for _, of_game in games]).reshape(-1, len(side_of))
    seats = np.array([seating for seating, _ in games], dtype=np.int64).reshape(-1, sides)
    expected = [contestant_returns(of_game, side_of, seating) for seating, of_game in games]
    assert repr(returns_of_games(values, side_of, seats)) == repr(expected)


DIRECTIONS = Discrete(n=3, start=4)


PAIR = MultiDiscrete(nvec=[2, 3], start=[0, 1], shape=(2,), dtype="int64")


FORCE = Box(dtype="float32", shape=(2,), low=-1.0, high=2.0)


SWITCHES = MultiBinary(shape=(2,))


ILLEGAL = "illegal_action"


FAULTS: list[tuple[Leaf, Any, list[int] | None, str, str]] = [
    (DIRECTIONS, 7, None, ILLEGAL, "action 7, legal: 4 to 6"),
    (DIRECTIONS, 5, [1, 0, 1], ILLEGAL, "action 5, legal: 4, 6"),
    (PAIR, [1, 4], None, ILLEGAL, "action [1, 4], legal: from [0, 1] on, [2, 3] choices"),
    (PAIR, [1, 3], [1, 0, 1, 1, 1], ILLEGAL, "from [0, 1] on, [2, 3] choices, where action_mask is [1, 0, 1, 1, 1]"),
    (FORCE, [0.0, 3.0], None, ILLEGAL, "action [0.0, 3.0], legal: from -1.0 to 2.0"),
    (FORCE, [0.0, np.inf], None, "not_finite", "action [0.0, inf]"),
    (SWITCHES, [0, 2], None, ILLEGAL, "action [0, 2], legal: 0 or 1"),
    (FORCE, [0.5], None, "malformed", "actions are float64 [1, 1], expected float32 [1, 2]"),
    (DIRECTIONS, 4.0, None, "malformed", "actions are float64 [1], expected int64 [1]"),
]


def test_the_fault_of_an_action_is_described() -> None:
    for space, action, mask, reason, detail in FAULTS:
        masks = None if mask is None else np.array([mask], np.int8)
        problem = action_fault(Actions(np.array([action])), space, masks)
        assert (problem.reason, problem.detail.endswith(detail)) == (reason, True), problem.detail
    assert action_fault(Actions(np.array([6])), DIRECTIONS, np.array([[0, 1, 1]], np.int8)) is None
    assert action_fault(Actions(np.array([[1, 3]])), PAIR, None) is None
    answer = Actions(np.array([4]), {"state_in_0": np.zeros((2, 8), np.float32)})
    assert action_fault(answer, DIRECTIONS, None) == PolicyFault("malformed", "state_in_0 has 2 rows, expected 1")


kinds = pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)


REFS = ["kind@1", "kind@2", "script:random"]


@kinds
def test_games_are_equal_in_any_number_of_environments_and_stored_and_replayed_exactly(kind: Kind) -> None:
    schedule = kind.schedule(REFS)
    sequential = kind.play(schedule, num_envs=1)
    assert [match.position for match in sequential] == list(range(9))
    for num_envs in (4, 32):
        assert kind.play(schedule, num_envs) == sequential
    environment = stock_stepping(kind.config.environment, 1)
    for match in sequential:
        admit(match, schedule)
        stored = replace(match, games=load_games(dump_games(match.games)))
        assert stored == match
        for index, game in enumerate(stored.games):
            steps = list(replay(environment, kind.config, kind.interface, stored, index))
            assert [move.action for step in steps for move in step.moves] == [*game.opening, *game.actions]


@kinds
def test_a_match_equals_the_shown_game(kind: Kind) -> None:
    """A shown game calls the policy of each agent separately, and carries its state itself."""
    schedule = kind.schedule(["kind@1", "kind@2"], plies=0)
    environment = stock_stepping(kind.config.environment, 1)
    side = {agent: i for i, agents in enumerate(kind.interface.sides.values()) for agent in agents}
    for match in kind.play(schedule):
        for game in match.games:
            seats = {agent: match.contestants[game.sides[side[agent]]] for agent in kind.interface.agents}
            players = {agent: kind.roster[ref][agent][1] for agent, ref in seats.items()}
            steps = list(play_game(environment, players, game.seed))
            assert tuple(move.action for step in steps for move in step.moves) == game.actions


@kinds
def test_an_identical_policy_scores_even_and_exchanged_contestants_have_exchanged_results(kind: Kind) -> None:
    for match in kind.play(kind.schedule(["kind@1", "kind@3"], blocks=6)):
        assert match.score(0) == match.score(1) == 0.5
        assert match.mean_return(0) == pytest.approx(match.mean_return(1), abs=1e-12)
    forward, backward = (kind.schedule(pair, blocks=6) for pair in (["kind@1", "kind@2"], ["kind@2", "kind@1"]))
    backward = replace(backward, id=forward.id, seed=forward.seed)
    scores = [match.score(0) for match in kind.play(forward)]
    assert [match.score(1) for match in kind.play(backward)] == scores


@pytest.mark.slow
@pytest.mark.parametrize("scoring", ["game", "side"])
def test_random_policies_score_even_on_unequal_sides(scoring: Scoring) -> None:
    """Four sides, three hunters and one hunted: the side decides a game, but not the mean of blocks."""
    roles = {"hunters": ["adversary_*"], "hunted": ["agent_*"]}
    kind = Kind("mpe2.simple_tag_v3", {}, None, roles)
    schedule = replace(kind.schedule(["script:random", "script:again"], blocks=160, plies=0), scoring=scoring)
    matches = kind.play(schedule, num_envs=16)
    scores = np.array([match.score(0) for match in matches])
    assert abs(scores.mean() - 0.5) < 4 * scores.std() / np.sqrt(len(scores))
    by_seat = [np.mean([match.games[0].scores[0] for match in matches[seat::4]]) for seat in range(4)]
    if scoring == "game":
        assert max(by_seat) - min(by_seat) > 0.2
        assert {tuple(sorted(set(game.sides))) for match in matches for game in match.games} == {(0, 1)}


def test_with_one_side_each_contestant_plays_alone() -> None:
    kind = KINDS["team"]
    for match in kind.play(kind.schedule(["kind@1", "kind@2"])):
        first, second = match.games
        assert (first.sides, second.sides) == ((0,), (1,))
        assert first.returns[1] is second.returns[0] is None
        assert first.opening == second.opening
        assert first.actions != second.actions


def test_an_opening_and_a_move_consist_of_steps_of_all_agents() -> None:
    kind = KINDS["free for all"]
    matches = kind.play(kind.schedule(["kind@1", "kind@2"], blocks=6, plies=2))
    assert {len(game.opening) for match in matches for game in match.games} == {2 * 3}
    assert {len(game.actions) for match in matches for game in match.games} == {4 * 3}
    openings = [{game.opening for game in match.games} for match in matches]
    assert all(len(opening) == 1 for opening in openings)
    assert len(set.union(*openings)) == len(matches)
    schedule = kind.schedule(["kind@1", "kind@2"])
    assert kind.play(schedule, max_moves=6)
    with pytest.raises(GameHung, match="after 5 moves"):
        kind.play(schedule, max_moves=5)


ENVIRONMENT = {
    "entry_point": "policy_league.examples.kuhn_poker:env",
    "vector": "policy_league.examples.kuhn_poker_vector:KuhnPokerVector",
}


KUHN = LeagueConfig.from_mapping({"league": "kuhn", "environment": ENVIRONMENT, "policies": {"shared": ["*"]}})


CARDS = interface(KUHN)


GAMBLERS = ["kuhn@1", "kuhn@2", "script:random"]


def roster_of(has_distribution: bool = True) -> Roster:
    spaces = CARDS.of_policy("shared")
    policies = {"script:random": script("random", spaces.observation, spaces.action)}
    for seed, ref in enumerate(GAMBLERS[:2]):
        policies[ref] = OnnxPolicy(masked_mlp((11,), 2, seed=seed), has_distribution=has_distribution)
    return {ref: dict.fromkeys(CARDS.agents, ("shared", policy)) for ref, policy in policies.items()}


def play_kuhn(schedule: Schedule, num_envs: int, stock: bool = False, roster: Roster | None = None) -> list[Match]:
    environment = (stock_stepping if stock else stepping)(KUHN.environment, num_envs)
    return play_matches(schedule, range(schedule.length), environment, CARDS, roster or roster_of())


def schedule_of(blocks: int, seed: int = 0) -> Schedule:
    return round_robin(KUHN, CARDS, GAMBLERS, blocks, seed)


def test_numbers_differ_between_games_agents_and_steps_only() -> None:
    keys = action_keys(np.array([5, 5, 2**62]), np.array([0, 1, 0]), agents=2)
    assert (keys[0] >> np.uint64(1)).tolist() == [derive(5, "action", 0, agent) for agent in (0, 1)]
    numbers = ActionNumbers(np.repeat(keys.ravel(), 100), np.tile(np.arange(100), 6))
    drawn = numbers.draw((3,))
    assert drawn.shape == (600, 3)
    assert len(np.unique(drawn)) == 1800
    assert kstest(drawn.ravel(), "uniform").pvalue > 0.01
    np.testing.assert_array_equal(numbers.row(7).draw((3,)), drawn[7:8])


def test_sampled_games_are_equal_in_any_number_of_environments_and_replayed_exactly() -> None:
    schedule = schedule_of(blocks=4)
    expected = play_kuhn(schedule, 1, stock=True)
    assert len(expected) == 12
    for num_envs in (1, 32, 512):
        assert play_kuhn(schedule, num_envs) == expected
    environment = stock_stepping(KUHN.environment, 1)
    for match in expected:
        for game in range(2):
            assert list(replay(environment, KUHN, CARDS, match, game))[-1].is_over
    assert [match.games for match in play_kuhn(schedule_of(4, seed=1), 32)] != [match.games for match in expected]


def test_policies_without_a_distribution_stay_greedy_and_others_differ_within_a_block() -> None:
    """With greedy actions, both games of a block are the same game if the contestants are."""
    schedule, roster = replace(schedule_of(blocks=4), id="equal"), roster_of(has_distribution=False)
    assert play_kuhn(schedule, 32, roster=roster) == play_kuhn(replace(schedule, actions="greedy"), 32)
    alike = roster_of()
    alike["kuhn@2"] = alike["kuhn@1"]
    sampled = round_robin(KUHN, CARDS, GAMBLERS[:2], 30)
    different = {}
    for schedule in (sampled, replace(sampled, actions="greedy")):
        matches = play_kuhn(schedule, 64, roster=alike)
        different[schedule.actions] = sum(match.games[0].actions != match.games[1].actions for match in matches)
    assert different["greedy"] == 0
    assert different["sampled"] > 10


def test_first_actions_have_the_distribution_of_the_policy() -> None:
    policy, environment = roster_of()["kuhn@1"]["player_0"][1], stock_stepping(KUHN.environment, 1)
    actions_of: defaultdict[bytes, list[int]] = defaultdict(list)
    for match in play_kuhn(round_robin(KUHN, CARDS, GAMBLERS[:2], 400), 512):
        game = replay(environment, KUHN, CARDS, match, 0)
        next(game)
        (move,) = next(game).moves
        actions_of[move.observation["observation"].tobytes()].append(move.action)
    assert len(actions_of) == 3, "one observation for each card"
    for observation, actions in actions_of.items():
        array, mask = np.frombuffer(observation, np.int8)[np.newaxis], np.ones((1, 2), np.int8)
        logits = policy.distribution({"observation": array, "action_mask": mask}).dist_inputs
        ((_, bet),) = probabilities(logits, Discrete(n=2))
        assert 0.2 < bet < 0.8
        assert binomtest(sum(actions), len(actions), bet).pvalue > 0.01


@pytest.mark.parametrize("name", ["roles", "memory"])
def test_sampled_actions_of_all_kinds_are_played_and_replayed(name: str) -> None:
    kind = KINDS[name]
    schedule = replace(kind.schedule(["kind@1", "kind@2"], blocks=2), actions="sampled")
    matches = kind.play(schedule, num_envs=1)
    assert matches == kind.play(schedule, num_envs=3)
    assert not any(game.forfeits for match in matches for game in match.games)
    environment = stock_stepping(kind.config.environment, 1)
    assert list(replay(environment, kind.config, kind.interface, matches[0], 1))[-1].is_over
    greedy = kind.play(replace(schedule, actions="greedy"), num_envs=3)
    assert [match.games for match in greedy] != [match.games for match in matches]


MIXTURE = "tictactoe@3"


def mixture(share: float) -> Mixture:
    shares = {1: share, 2: 1 - share}
    return Mixture(members=tuple(Member(version=n, probability=p, sha256="0" * 64) for n, p in shares.items()))


@given(st.floats(0.05, 0.95), st.integers(0, 2**40), st.integers(0, 50))
@settings(max_examples=30, deadline=None)
def test_a_draw_depends_on_the_game_only(share: float, seed: int, position: int) -> None:
    schedule = replace(round_robin(tictactoe.config(), INTERFACE, [MIXTURE, *CONTESTANTS[2:]], 100), seed=seed)
    mixtures = {MIXTURE: mixture(share)}
    positions = [position, position + 7, position + 20]
    together = acting_versions(schedule, game_plans(schedule, positions), mixtures)
    alone = [acting_versions(schedule, game_plans(schedule, [one]), mixtures).members for one in positions]
    assert together.members == tuple(members for two in alone for members in two)
    for plan, members in zip(game_plans(schedule, positions).contestants, together.members, strict=True):
        assert [member is not None for member in members] == [index == 0 for index in plan] or members == ()


def test_members_play_their_shares() -> None:
    schedule = round_robin(tictactoe.config(), INTERFACE, [MIXTURE, "script:random"], 1000)
    drawn = acting_versions(schedule, game_plans(schedule, range(1000)), {MIXTURE: mixture(0.3)})
    games = Counter(members[0] for members in drawn.members)
    assert 500 < games[1] < 700
    assert games[1] + games[2] == 2000


def test_the_member_plays_as_it_does_alone() -> None:
    """Every recorded game equals the game of the member that was drawn."""
    mixed = round_robin(tictactoe.config(), INTERFACE, [MIXTURE, "script:one_ply"], 12)
    roster = build_roster()
    environment, mixtures = stock_stepping(CONFIG.environment, 5), {MIXTURE: mixture(0.5)}
    matches = play_matches(mixed, range(12), environment, INTERFACE, roster, mixtures=mixtures)
    alone = {}
    for number in (1, 2):
        schedule = replace(mixed, contestants=(f"tictactoe@{number}", "script:one_ply"))
        alone[number] = play_matches(schedule, range(12), stock_stepping(CONFIG.environment, 5), INTERFACE, roster)
    played = [(match.position, index, game) for match in matches for index, game in enumerate(match.games)]
    assert {game.members[0] for *_, game in played} == {1, 2}
    for position, index, game in played:
        member = game.members[0]
        assert member is not None
        assert matches[position].acting(index) == (f"tictactoe@{member}", "script:one_ply")
        expected = alone[member][position].games[index]
        assert (game.actions, game.opening, game.returns) == (expected.actions, expected.opening, expected.returns)


def test_members_are_part_of_the_record() -> None:
    game = Game((0, 1), 7, (), (1, 2), (1.0, -1.0), (1.0, 0.0), members=(5, None))
    plain = replace(game, members=())
    assert load_games(dump_games([game, plain])) == (game, plain)
    assert "members" not in dump_games([plain])


@pytest.fixture
def registry(tmp_path: Path) -> Iterator[Registry]:
    """Tic-tac-toe with three versions, and a mixture of two as its champion."""
    with closing(tictactoe.registry(tmp_path / "home", play={"opening_plies": 2, "num_envs": 2})) as opened:
        for strength in STRENGTHS:
            tictactoe.publish(opened, tictactoe.graph(**strength))
        number = opened.publisher.publish_mixture(tictactoe.LEAGUE, {1: 0.5, 3: 0.5}).number
        opened.aliases.set(tictactoe.LEAGUE, "champion", number, expected=ANY, actor="me", reason="test")
        yield opened


def test_a_mixture_is_one_contestant_and_its_games_are_replayed(registry: Registry) -> None:
    refs = ["tictactoe@champion", "tictactoe@2"]
    report = evaluate(tictactoe.LEAGUE, refs, registry=registry, schedule="gauntlet", blocks=4)
    assert "tictactoe@4" in [standing.ref for standing in report.leaderboard]
    ledger = Ledger(registry)
    matches = [m for m in ledger.matches(league=tictactoe.LEAGUE) if m.contestants[0] == "tictactoe@4"]
    assert {game.members[0] for match in matches for game in match.games} == {1, 3}
    for match in matches[:3]:
        source = recorded_game(match.id, 1, registry, chances=True)
        assert set(source.controllers.values()) == set(match.acting(1))
        with closing(stock_stepping(source.config.environment, 1)) as environment:
            assert list(source.play(environment))[-1].is_over
    schedule = ledger.schedule(matches[0].schedule)
    assert play_schedule(schedule, registry=registry) == ledger.matches(league=tictactoe.LEAGUE, schedule=schedule.id)


def test_a_live_game_is_played_by_one_member(registry: Registry) -> None:
    """A mixture has no policies of its own."""
    refs = {live_game(["tictactoe@champion"], registry, seed=seed).controllers["player_1"] for seed in range(20)}
    assert refs == {"tictactoe@1", "tictactoe@3"}
    message = r"tictactoe@4 is a mixture \(@1 50.0 %, @3 50.0 %\): name one of its members"
    with pytest.raises(InvalidInput, match=message):
        contestant("tictactoe@4", registry, INTERFACE)


def test_an_episode_without_actions_is_recorded_as_empty() -> None:
    assert ActionLog().of(np.array([0]), np.array([0]), 2) == [((), ())]
