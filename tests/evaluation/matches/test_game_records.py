"""Games without a valid action are forfeited, and all others are unaffected; upsets; sums of all that is counted."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.matches import game_records
from evaluation.matches.game_loop import play_matches
from evaluation.matches.game_records import Upset, forfeit_difference, forfeits, forfeits_of_all
from evaluation.matches.leaderboard import CountedGames, compute_leaderboard, rank_contestants
from evaluation.matches.policy_calls import fault_of
from evaluation.matches.seating import Roster
from evaluation.matches.tournament import evaluate
from evaluation.playback.replay import recorded_game, replay
from evaluation.schedules.builders import round_robin
from evaluation.statistics.payoff import paired_difference, tabulate
from league.conditions import Conditions
from league.environments.implementation import stock_stepping
from league.errors import EnvironmentMismatch, IllegalMask
from league.policies.loading import contestant
from league.policies.policy import Actions, Arrays, Policy
from league.registry.registry import Registry
from league.registry.storage import tables
from league.results.ledger import Ledger
from league.results.records import MAX_DETAIL, Forfeit, Game, Match, Reason, Schedule, Scoring, dump_games, load_games
from league.results.scoring import admit, scores
from league.results.sums import GameSums, examples, game_digest, load_examples, merged, tally, whole
from league.settings import Storage
from tests.support.environments.kinds import KINDS, Kind
from tests.support.environments.lockstep import CONFIG, CONTESTANTS, INTERFACE, build_roster
from tests.support.leagues import tictactoe
from tests.support.leagues.ledger_matches import SCHEDULE
from tests.support.leagues.registries import LEAGUE, registered
from tests.support.policies import bots
from tests.support.policies.bots import MODULE
from tests.support.policies.illegal_action_graph import illegal_action_graph

BAD = "tictactoe@9"


NUM_ENVS = (1, 5, 32)


@dataclass
class Faulty:
    """A policy with a fault: it changes the answer for rows where `flaw` is true."""

    good: Policy
    flaw: Callable[[Any], bool]
    answer: Callable[[Actions], Actions]

    def act(
        self,
        observations: Arrays,
        *,
        state: Arrays | None = None,
        explore: bool = False,
        rng: Sequence[np.random.Generator] | None = None,
    ) -> Actions:
        answer = self.good.act(observations, state=state, explore=explore, rng=rng)
        rows = [row for row, observation in enumerate(observations["observation"]) if self.flaw(observation)]
        return self.answer(answer, rows) if rows else answer


def raises(answer: Actions, rows: list[int]) -> Actions:
    raise RuntimeError(f"no idea what to do in {len(rows)} of {len(answer.actions)} positions")


def illegal(answer: Actions, rows: list[int]) -> Actions:
    """Plays the square 99."""
    return replace(answer, actions=np.where(np.isin(np.arange(len(answer.actions)), rows), 99, answer.actions))


def five_marks(board: np.ndarray) -> bool:
    return int(board.sum()) >= 5


FLAWS: dict[str, tuple[Any, Reason]] = {
    "illegal": (illegal, "illegal_action"),
    "raises": (raises, "crashed"),
    "floats": (lambda answer, _: replace(answer, actions=answer.actions.astype(np.float32)), "malformed"),
    "misshapen": (lambda answer, _: replace(answer, actions=answer.actions[:, None]), "malformed"),
    "too few": (lambda answer, _: replace(answer, actions=answer.actions[:0]), "malformed"),
    "nothing": (lambda *_: None, "crashed"),
}


def policy_of(ref: str) -> Policy:
    return build_roster()[ref]["player_1"][1]


def faulty(flaw: Any, good: str = "tictactoe@2") -> Policy:
    return Faulty(policy_of(good), five_marks, flaw)


def with_faulty(policy: Policy, ref: str = BAD) -> Roster:
    return {**build_roster(), ref: dict.fromkeys(INTERFACE.agents, ("shared", policy))}


def play(schedule: Schedule, rosters: Roster, num_envs: int = 8, positions: Sequence[int] | None = None) -> Any:
    positions = range(schedule.length) if positions is None else positions
    return play_matches(schedule, positions, stock_stepping(CONFIG.environment, num_envs), INTERFACE, rosters)


def schedule_of(*contestants: str, blocks: int = 4) -> Schedule:
    return round_robin(tictactoe.config(play={"opening_plies": 2}), INTERFACE, contestants, blocks)


@pytest.mark.parametrize("name", FLAWS)
def test_only_games_without_a_valid_action_are_forfeited(name: str) -> None:
    """Until then the games equal those of the policy without the fault, and all other games are identical."""
    flaw, reason = FLAWS[name]
    schedule = schedule_of(*CONTESTANTS, BAD, blocks=3)
    faultless = play(schedule, with_faulty(policy_of("tictactoe@2")))
    expected = [
        replace(match, games=tuple(game_with_fault(match, game, reason) for game in match.games)) for match in faultless
    ]
    matches = play(schedule, with_faulty(faulty(flaw)))
    for match, other in zip(matches, expected, strict=True):
        for game, like in zip(match.games, other.games, strict=True):
            assert (game.actions, game.forfeits) == (like.actions, like.forfeits), match.id
            assert game == like or game.forfeits
    assert 0 < forfeits(matches, BAD) < 2 * 4 * 3
    assert forfeits(matches, "tictactoe@1") == 0
    for num_envs in NUM_ENVS:
        assert play(schedule, with_faulty(faulty(flaw)), num_envs) == matches


def game_with_fault(match: Match, game: Game, reason: Reason) -> Game:
    """A game of the faultless policy with the fault: it ends in the turn where that sees five or more marks."""
    if BAD not in match.contestants:
        return game
    bad = match.contestants.index(BAD)
    for turn in range(len(game.actions)):
        marks = turn + len(game.opening)
        side = marks % 2
        if marks >= 5 and game.sides[side] == bad:
            lost = Forfeit(bad, INTERFACE.sides[f"player_{side + 1}"][0], reason)
            return replace(game, actions=game.actions[:turn], forfeits=(lost,))
    return game


def test_a_crashing_script_forfeits_without_affecting_the_draws_of_others() -> None:
    """It raises after drawing for the whole batch, which must not change the next draws of others."""
    schedule = schedule_of("script:flaky", "script:random", blocks=12)
    rosters = with_faulty(faulty(raises, good="script:random"), "script:flaky")
    sequential = play(schedule, rosters, num_envs=1)
    assert 0 < forfeits(sequential, "script:flaky") < 24
    for num_envs in NUM_ENVS:
        assert play(schedule, rosters, num_envs) == sequential
    sound = play(schedule, with_faulty(policy_of("script:random"), "script:flaky"))
    pairs = [(a, b) for m, n in zip(sequential, sound, strict=True) for a, b in zip(m.games, n.games, strict=True)]
    assert all(a == b for a, b in pairs if not a.forfeits)
    assert all(a.actions == b.actions[: len(a.actions)] for a, b in pairs)


def test_a_policy_that_fails_only_in_batches_forfeits_nothing() -> None:
    """If a batch fails, each row is evaluated alone."""

    class UnbatchedOnly(Faulty):
        def act(self, observations: Arrays, **rest: Any) -> Actions:
            assert len(observations["action_mask"]) == 1, "one row at a time"
            return self.good.act(observations, **rest)

    good, schedule = policy_of("tictactoe@2"), schedule_of("tictactoe@1", BAD)
    solitary = UnbatchedOnly(good, five_marks, raises)
    assert play(schedule, with_faulty(solitary)) == play(schedule, with_faulty(good))


def test_the_first_move_can_be_forfeited() -> None:
    schedule = replace(schedule_of("script:random", BAD, blocks=3), opening_plies=0)
    always_failing = Faulty(policy_of("tictactoe@1"), lambda board: True, raises)
    for match in play(schedule, with_faulty(always_failing)):
        faulty_index = match.contestants.index(BAD)
        assert all(faulty_index in {forfeit.contestant for forfeit in game.forfeits} for game in match.games)
        assert sorted(len(game.actions) for game in match.games) == [0, 1]
        assert match.score(faulty_index) == 0
        admit(match, schedule)


def test_forfeits_are_stored_accepted_and_replayed() -> None:
    schedule = schedule_of("script:one_ply", BAD, blocks=10)
    environment, forfeited = stock_stepping(CONFIG.environment, 1), 0
    for match in play(schedule, with_faulty(faulty(illegal))):
        admit(match, schedule)
        stored = replace(match, games=load_games(dump_games(match.games)))
        assert stored == match
        for index, game in enumerate(stored.games):
            steps = list(replay(environment, CONFIG, INTERFACE, stored, index))
            assert [move.action for step in steps for move in step.moves] == [*game.opening, *game.actions]
            assert [step.is_over for step in steps] == [False] * (len(steps) - 1) + [True]
            forfeited += bool(game.forfeits)
    assert forfeited


def test_rows_without_forfeits_can_be_read() -> None:
    (game, _) = load_games("[5,[1,2],[[[0,1],[3,4],[1.0,-1.0],[1.0,0.0]],[[1,0],[3,4],[1.0,-1.0],[1.0,0.0]]]]")
    assert game == Game((0, 1), 5, (1, 2), (3, 4), (1.0, -1.0), (1.0, 0.0))
    assert dump_games([game]) == "[5,[1,2],[[[0,1],[3,4],[1.0,-1.0],[1.0,0.0]]]]"


def test_a_forged_forfeit_is_detected_by_replay() -> None:
    matches = play(schedule_of("script:one_ply", BAD, blocks=10), with_faulty(faulty(raises)))
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    game, environment = match.games[index], stock_stepping(CONFIG.environment, 1)
    by = game.forfeits[0]
    other = "player_1" if by.agent == "player_2" else "player_2"
    for change in (
        {"forfeits": (replace(by, contestant=1 - by.contestant),)},
        {"forfeits": (replace(by, agent=other),)},
        {"forfeits": (replace(by, agent="player_3"),)},
        {"actions": game.actions[:-1]},
        {"returns": (1.0, -1.0)},
    ):
        games = [replace(game, **change) if i == index else match.games[i] for i in range(2)]
        with pytest.raises(EnvironmentMismatch, match="cannot be replayed"):
            list(replay(environment, CONFIG, INTERFACE, replace(match, games=tuple(games)), index))


def test_a_mask_without_legal_actions_is_not_a_forfeit() -> None:
    environment = stock_stepping(CONFIG.environment, 2)
    start = environment.start

    def start_without_legal_actions(next_episode: Any) -> Any:
        turn = start(next_episode)
        for batch in turn.batches.values():
            batch.observations["action_mask"][:] = 0
        return turn

    environment.start = start_without_legal_actions  # type: ignore[method-assign]
    schedule = replace(schedule_of("tictactoe@1", "tictactoe@2"), opening_plies=0)
    with pytest.raises(IllegalMask, match="allows no action"):
        play_matches(schedule, [0], environment, INTERFACE, build_roster())


@dataclass
class FailingAtStep:
    """Acts until the `step`-th call of an episode, counted in its state, and then returns NaN."""

    step: int
    width: int

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        rows = len(observations["observation"])
        steps = np.zeros((rows, 1), np.float32) if state is None else state["state_in_0"]
        actions = np.where(steps == self.step, np.nan, 0.5) * np.ones((rows, self.width))
        return Actions(actions.astype(np.float32), {"state_in_0": steps + 1})


CONTINUOUS = {"max_cycles": 6, "continuous_actions": True}


FREE = Kind("mpe2.simple_spread_v3", CONTINUOUS, None)


SIDES = {"adversary": ["adversary_*"], "good": ["agent_*"]}


ROLES = Kind("mpe2.simple_adversary_v3", CONTINUOUS, SIDES, SIDES)


SOLO = KINDS["continuous team"]


NEVER = 99


def play_pair(kind: Kind, first: int, second: int, num_envs: int = 4) -> tuple[Schedule, list[Match]]:
    """Matches of two contestants that fail at these steps."""
    schedule = kind.schedule(["kind@a", "kind@b"], plies=1)
    environment = stock_stepping(kind.config.environment, num_envs)
    roster = {
        ref: {agent: (name, FailingAtStep(step, 5)) for agent, name in kind.interface.policies.items()}
        for ref, step in zip(schedule.contestants, (first, second), strict=True)
    }
    return schedule, play_matches(schedule, range(schedule.length), environment, kind.interface, roster)


def test_a_forfeit_ends_the_game_for_all_agents_and_two_are_a_draw() -> None:
    schedule, matches = play_pair(FREE, 3, NEVER)
    for match in matches:
        admit(match, schedule)
        for game in match.games:
            assert game.forfeits == (Forfeit(0, f"agent_{game.sides.index(0)}", "not_finite"),)
            assert len(game.actions) == 3 * 3
            assert game.scores == (0.0, 1.0)
    assert play_pair(FREE, 3, NEVER, num_envs=1)[1] == matches
    schedule, matches = play_pair(FREE, 2, 2)
    for match in matches:
        admit(match, schedule)
        for game in match.games:
            assert {forfeit.contestant for forfeit in game.forfeits} == {0, 1}
            assert game.scores == (0.5, 0.5)


@dataclass
class Constant:
    """Always returns the same action, in another dtype than the space."""

    def act(self, observations: Arrays, *, state: Any = None, explore: bool = False, rng: Any = None) -> Actions:
        return Actions(np.full((len(observations["observation"]), 5), 0.1, np.float64))


def test_actions_are_recorded_in_the_dtype_of_the_policy() -> None:
    """Rows are evaluated alone if a batch fails, which must not change the records."""
    schedule = FREE.schedule(["kind@a", "kind@b"], plies=0, blocks=6)
    policies = {
        "kind@a": Faulty(Constant(), lambda observation: bool(observation[2] > 0.8), raises),
        "kind@b": Constant(),
    }
    rosters = {ref: dict.fromkeys(FREE.interface.agents, ("shared", policy)) for ref, policy in policies.items()}

    def play(num_envs: int) -> list[Match]:
        environment = stock_stepping(FREE.config.environment, num_envs)
        return play_matches(schedule, range(schedule.length), environment, FREE.interface, rosters)

    alone = play(1)
    assert 0 < forfeits(alone, "kind@a") < 12
    assert {number for match in alone for game in match.games for action in game.actions for number in action} == {0.1}
    assert play(4) == play(12) == alone


@pytest.mark.parametrize("kind", [SOLO, ROLES], ids=["solo", "roles"])
def test_compared_by_side_a_forfeit_loses_the_block(kind: Kind) -> None:
    environment = stock_stepping(kind.config.environment, 1)
    for first, second, expected in ((3, NEVER, 0.0), (NEVER, 0, 1.0), (2, 2, 0.5)):
        schedule, matches = play_pair(kind, first, second)
        assert schedule.scoring == "side"
        for match in matches:
            admit(match, schedule)
            assert (match.score(0), match.score(1)) == (expected, 1 - expected)
            assert forfeit_difference(match, "kind@a") == 2 * expected - 1
            assert forfeit_difference(match, "kind@b") == 1 - 2 * expected
            for index, game in enumerate(match.games):
                assert all(forfeit.reason == "not_finite" for forfeit in game.forfeits)
                assert list(replay(environment, kind.config, kind.interface, match, index))[-1].is_over


def test_a_forfeited_game_has_no_return() -> None:
    """In simple_spread each step has a cost, so that a game which ends early would have a better return."""
    _, matches = play_pair(SOLO, 0, NEVER)
    assert all(match.games[0].returns[0] > match.games[1].returns[1] for match in matches)
    assert {match.mean_return(0) for match in matches} == {match.result().returns for match in matches} == {None}
    assert paired_difference(matches, "kind@a") is None
    table = {standing.ref: standing for standing in rank_contestants(whole(tally(matches)))}
    assert (table["kind@a"].mean_return, table["kind@a"].score, table["kind@a"].games) == (None, 0.0, len(matches))
    _, complete = play_pair(SOLO, NEVER, NEVER)
    assert {forfeit_difference(match, "kind@a") for match in complete} == {None}
    mixed = rank_contestants(whole(tally([*matches, *complete])))
    assert mixed[0].mean_return == pytest.approx(np.mean([match.mean_return(0) for match in complete]))


@pytest.mark.parametrize("crashes", [False, True], ids=["illegal", "crashes"])
def test_a_tournament_continues_with_a_version_that_forfeits(tmp_path: Path, crashes: bool) -> None:
    registry = tictactoe.registry(tmp_path, play={"opening_plies": 2, "num_envs": 32})
    for graph in (tictactoe.graph(), illegal_action_graph(crashes)):
        tictactoe.publish(registry, graph)
    report = evaluate(tictactoe.LEAGUE, registry=registry, blocks=8)
    matches = Ledger(registry).matches(league=tictactoe.LEAGUE)
    lost = report.forfeits["tictactoe@2"]
    assert lost.games == forfeits(matches, "tictactoe@2")
    assert lost.reasons == {"crashed" if crashes else "illegal_action": lost.games}
    leaderboard = compute_leaderboard(registry, tictactoe.LEAGUE)
    assert leaderboard[-1].ref == "tictactoe@2"
    assert {standing.ref: standing.mean_return for standing in leaderboard}["tictactoe@1"] is not None
    match, index = next((m, i) for m in matches for i, game in enumerate(m.games) if game.forfeits)
    assert recorded_game(match.id, index, registry).note.startswith("forfeited by tictactoe@2 as player_")


EXCEPTION = r"by an exception \(the first: "


@pytest.mark.parametrize(
    ("name", "reason", "sentence"),
    [
        ("Failing", "crashed", EXCEPTION + r"RuntimeError: no idea at bots.py, line {RuntimeError}\)"),
        ("Leaving", "crashed", EXCEPTION + r"ExitCalled: sys.exit\('bye'\) .* at bots.py, line {sys.exit}\)"),
        ("failing_at_once", "crashed", EXCEPTION + r"ValueError: cannot reshape .* at bots.py, line {reshape}\)"),
        ("taken", "illegal_action", r"by an illegal action \(the first: action (\d), legal: (?!.*\1.*\))[\d, ]*\)"),
        (
            "text",
            "malformed",
            r"by an output that is no action \(the first: the bot returned str 'left': expected int64 \[\]\)",
        ),
    ],
)
def test_forfeits_of_a_bot_are_reported_with_the_first_fault(name: str, reason: Reason, sentence: str) -> None:
    """An exception with the line of the bot that raised it, an action with those that were legal."""
    lines = Path(bots.__file__).read_text().splitlines()
    for word in ("RuntimeError", "sys.exit", "reshape"):
        place = 1 + next(i for i, line in enumerate(lines) if word in line)
        sentence = sentence.replace(f"{{{word}}}", str(place))
    contestants = ["script:random", f"script:{MODULE}:{name}"]
    roster = {ref: contestant(ref, None, INTERFACE) for ref in contestants}
    games = play(schedule_of(*contestants, blocks=10), roster)
    matches = [replace(match, games=load_games(dump_games(match.games))) for match in games]
    ((bot, lost),) = forfeits_of_all(matches).items()
    assert (bot, lost.reasons) == (contestants[1], {reason: lost.games})
    assert re.fullmatch(rf"{lost.games} games: {lost.games} {sentence}", str(lost))
    assert lost.games == sum(bool(game.forfeits) for match in matches for game in match.games) > 0
    assert {forfeit.contestant for match in matches for game in match.games for forfeit in game.forfeits} == {1}
    assert name != "Failing" or lost.games < 20, "only the game in which it occurs is forfeited"


def test_a_long_message_of_a_bot_is_cut() -> None:
    assert len(fault_of(ValueError("x" * 10_000)).detail) == MAX_DETAIL


def test_the_example_of_a_bot_beats_random_play() -> None:
    contestants = ["script:random", "script:policy_league.examples.tictactoe_bot:act"]
    roster = {ref: contestant(ref, None, INTERFACE) for ref in contestants}
    scores = [match.score(1) for match in play(schedule_of(*contestants, blocks=10), roster)]
    assert sum(scores) / len(scores) > 0.8


RATINGS = {"duel@1": 0.0, "duel@2": 400.0, "duel@3": 800.0}


PAIR, BEST = ("duel@1", "duel@2"), ("duel@1", "duel@3")


def match_of(position: int, contestants: tuple[str, str], *scores: float, moves: int | None = None) -> Match:
    """One game for each score of the first contestant; its moves identify it."""
    number = position if moves is None else moves
    games = tuple(
        Game((0, 1), position, (), (number, index), (score, 1 - score), (score, 1 - score))
        for index, score in enumerate(scores)
    )
    return Match(f"s/{position}", "duel", "s", position, contestants, position, "digest", games)


def upsets_of(matches: list[Match], limit: int = 3) -> list[Upset]:
    of_pairs = examples(matches, [[game_digest(match, game) for game in match.games] for match in matches])
    return game_records.greatest_upsets(RATINGS, of_pairs, of_pairs.__getitem__, limit)


def greatest_upsets(matches: list[Match], limit: int = 3) -> list[tuple[str, int, str]]:
    return [(upset.match, upset.game, upset.better) for upset in upsets_of(matches, limit)]


def test_the_least_expected_results_are_upsets() -> None:
    matches = [
        match_of(0, PAIR, 0.0, 1.0),
        match_of(1, ("duel@3", "duel@1"), 1.0, 0.0),
        match_of(2, ("duel@2", "duel@3"), 1.0, 0.0),
    ]
    assert greatest_upsets(matches) == [("s/1", 1, "duel@1"), ("s/0", 1, "duel@1"), ("s/2", 0, "duel@2")]
    assert greatest_upsets([match_of(0, PAIR, 0.0, 0.5)]) == [("s/0", 1, "duel@1")], "a draw of unequals is one"
    assert greatest_upsets([match_of(0, PAIR, 0.0, 0.0)]) == []
    (upset,) = upsets_of([match_of(0, PAIR, 1.0)], limit=1)
    assert (upset.other, upset.score, round(upset.expected, 3)) == ("duel@2", 1.0, 0.091)
    block = match_of(0, BEST, 1.0)
    assert greatest_upsets([replace(block, contestants=("duel@9", "duel@3"))]) == [], "unrated contestants have none"
    solo = (
        replace(block.games[0], sides=(0,), scores=(1.0, None)),
        replace(block.games[0], sides=(1,), scores=(None, 0.0)),
    )
    assert greatest_upsets([replace(block, games=solo)]) == [("s/0", 0, "duel@1")], "compared with each other"


def test_each_pair_is_listed_once_before_any_is_repeated_and_each_game_once() -> None:
    matches = [match_of(i, BEST, 1.0) for i in range(5)]
    pairs = [("s/0", 0, "duel@1"), ("s/9", 0, "duel@1")]
    assert greatest_upsets([*matches, match_of(9, PAIR, 1.0)], limit=2) == pairs
    assert len(greatest_upsets(matches, limit=3)) == 3, "then the others follow"
    assert greatest_upsets([match_of(i, BEST, 1.0, moves=7) for i in range(4)]) == [("s/0", 0, "duel@1")]
    matches = [match_of(i, BEST, 1.0, 0.5, moves=i // 2) for i in range(4)]
    matches.append(match_of(5, ("duel@2", "duel@3"), 1.0))
    assert len({tuple(greatest_upsets(list(order))) for order in permutations(matches)}) == 1, "in any order"


REFS = ("script:random", "tictactoe@1", "tictactoe@10", "tictactoe@2")


TWO = ("player_1", "player_2")


SCORINGS: dict[tuple[str, ...], tuple[Scoring, ...]] = {
    TWO: ("game", "side", "team"),
    ("a", "b", "c"): ("side", "game"),
    ("alone",): ("side",),
}


History = list[tuple[Schedule, list[list[Match]], bool]]
"""Schedules with the matches that are added at a time, and whether they are purged."""


@st.composite
def schedules(draw: st.DrawFn, number: int) -> Schedule:
    sides = draw(st.sampled_from(list(SCORINGS)))
    pairs = st.tuples(st.integers(0, 3), st.integers(0, 3))
    return replace(
        SCHEDULE,
        id=f"schedule-{number}",
        sides=sides,
        scoring=draw(st.sampled_from(SCORINGS[sides])),
        contestants=tuple(draw(st.permutations(REFS))),
        pairings=tuple(draw(st.lists(pairs, min_size=1, max_size=3))),
        length=2 * tables.STRIPE,
        opening_plies=0,
        game_digest=draw(st.sampled_from([SCHEDULE.game_digest, "0" * 64])),
        actions=draw(st.sampled_from(["greedy", "sampled"])),
    )


@st.composite
def matches_of(draw: st.DrawFn, schedule: Schedule) -> Match:
    """A match with few different returns and moves, so that games are repeated; some with forfeits or mixtures."""
    position = draw(st.integers(0, 6) | st.integers(tables.STRIPE - 1, tables.STRIPE + 2))
    returns, forfeits = [], []
    for index in range(2):
        seating = schedule.seating_at(position, index)
        value = st.sampled_from([-1.0, 0.0, 0.1, 1.0, 1e-3, 1e17])
        returns.append(tuple(draw(value) if contestant in seating else None for contestant in range(2)))
        losers = draw(st.sampled_from([(), (), (), tuple(sorted(set(seating))), seating[:1]]))
        forfeits.append(tuple(Forfeit(contestant, "agent", "crashed") for contestant in losers))
    points = scores(returns, schedule.scoring, [{part.contestant for part in of_game} for of_game in forfeits])
    members = draw(st.sampled_from([(), (1, None)]))
    games = [
        Game(
            schedule.seating_at(position, index),
            schedule.seed_at(position),
            (),
            (draw(st.integers(0, 1)),),
            returns[index],
            points[index],
            forfeits[index],
            members,
        )
        for index in range(2)
    ]
    return schedule.match(position, games)


@st.composite
def histories(draw: st.DrawFn) -> History:
    history = []
    for number in range(draw(st.integers(1, 4))):
        schedule = draw(schedules(number))
        batches = draw(st.lists(st.lists(matches_of(schedule), max_size=6), max_size=4))
        history.append((schedule, batches, draw(st.booleans())))
    return history


def check(registry: Registry, history: History) -> None:
    ledger = Ledger(registry)
    for schedule, batches, is_purged in history:
        ledger.open(schedule)
        for batch in batches:
            ledger.extend(batch)
            ledger.extend(batch[:2])
        if is_purged:
            ledger.purge([schedule.id])
    for schedule, _, _ in history:
        assert ledger.recount(schedule) == []
        assert ledger.counts(LEAGUE).get(schedule.id, 0) == len(ledger.positions(schedule.id))
    for conditions in {schedule.conditions for schedule, _, _ in history}:
        counted = ledger.counted(LEAGUE, conditions)
        matches = [match for schedule in counted for match in ledger.walk(schedule)]
        sums = ledger.sums(LEAGUE, counted)
        assert sums == tally(matches)
        digests = [[game_digest(match, game) for game in match.games] for match in matches]
        texts = ledger.examples(LEAGUE, counted)
        of_pairs = {pair: merged([load_examples(t, name) for name, t in parts]) for pair, parts in texts.items()}
        assert {pair: kinds for pair, kinds in of_pairs.items() if kinds} == examples(matches, digests)
        assert rank_contestants(whole(sums)) == rank_contestants(whole(tally(matches)))
        _check_counted_games(registry, conditions, [schedule for schedule in counted if schedule.sides == TWO])


def _check_counted_games(registry: Registry, conditions: Conditions, counted: list[Schedule]) -> None:
    """With the sides of the league, against the matches one by one."""
    row = registry.leagues.get(LEAGUE)
    played = CountedGames(registry, row, conditions)
    matches = [match for schedule in counted for match in Ledger(registry).walk(schedule)]
    assert (played.matches, played.games) == (len(matches), 2 * len(matches))
    assert played.unique_games == len({game_digest(match, game) for match in matches for game in match.games})
    results = [match.result() for match in matches]
    for standing in played.leaderboard:
        placed = [
            (result, place) for result in results for place in range(2) if result.contestants[place] == standing.ref
        ]
        assert standing.games == sum(result.games for result, _ in placed)
        assert standing.score == sum(result.scores[place] for result, place in placed) / standing.games
        of_ref = (match for match in matches if standing.ref in match.contestants)
        assert standing.unique_games == len({game_digest(match, game) for match in of_ref for game in match.games})
    if (payoff := played.payoff()) is not None:
        assert payoff == tabulate([standing.ref for standing in played.leaderboard], TWO, tally(matches))
    for pair, of_pair in played.sums.items():
        between = [match for match in matches if sorted(match.contestants) == list(pair)]
        assert of_pair.matches == len(between)
        assert of_pair.whole.complete == sum(match.mean_return(0) is not None for match in between)
        for number in range(2):
            alone = [score for match in between for score in _scores_of(match, pair[0], number)]
            of_side = of_pair.sides.get(number, GameSums())
            assert (of_side.played, of_side.points[0]) == (len(alone), sum(alone))


def _scores_of(match: Match, ref: str, side: int) -> list[float]:
    """Scores of a contestant in the games in which it, as first of its name, played a side."""
    contestant = match.contestants.index(ref)
    return [game.scores[contestant] or 0.0 for game in match.games if game.sides[side] == contestant]


def run(history: History) -> None:
    with TemporaryDirectory() as home, closing(registered(Registry.open(Storage.at(Path(home))))) as registry:
        check(registry, history)


@settings(max_examples=20)
@given(histories())
def test_generated_histories(history: History) -> None:
    run(history)


@pytest.mark.slow
@settings(max_examples=1000)
@given(histories())
def test_many_generated_histories(history: History) -> None:
    run(history)
